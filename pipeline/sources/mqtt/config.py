"""Settings of samples from an MQTT broker: `{ kind = "mqtt", url = "mqtt://broker", topic = "plant/tray1" }`."""

from __future__ import annotations

from typing import Literal, Self

from pydantic import Field, model_validator

from fantwin.pipeline.sources.mqtt.connection import BrokerSettings
from fantwin.pipeline.sources.own_json import OwnJson, has_other_braces, is_of_each_fan, of_fan
from fantwin.pipeline.sources.source import SourceConfig

Topics = str | tuple[str, ...]
"""one topic, with the number of the first fan in braces or for all fans; or one for each fan"""


def topic_of(topics: Topics, fan: int) -> str:
    """The topic of a fan."""
    return of_fan(topics, fan) if isinstance(topics, str) else topics[fan]


def are_of_each_fan(topics: Topics) -> bool:
    """Whether each fan has a topic of its own."""
    return not isinstance(topics, str) or is_of_each_fan(topics)


class MqttConfig(SourceConfig, BrokerSettings, OwnJson, frozen=True):
    """A broker, and the topics that have the samples: samples in JSON on one topic; or numbers of each fan, alone or in
    the device's own JSON (docs/how-to/sources.md)."""

    kind: Literal["mqtt"] = "mqtt"
    topic: Topics = Field(
        min_length=1,
        description="topic of samples in JSON, which may have the wildcards + and #; or of the speed of a fan, with "
        "the number of the first one in braces: plant/fan{1}/rpm; or a list of these",
    )
    command_topic: Topics = Field(
        default="", description="topic of the command of a fan, where topic is that of its speed; or one for all fans"
    )
    switch_topic: Topics = Field(
        default="", description="topic that says whether a fan is on (ON, OFF): the command of one that is off is 0"
    )
    switch_key: str = Field(default="", pattern="^(/.*)?$", description="where that is in the device's own JSON")
    send_topic: Topics = Field(
        default="",
        description="topic for commands of `fantwin command`, as JSON, or as a number where it is of each fan; without "
        "it none are sent",
    )
    client_id: str = Field(
        default="",
        description="id of this client, another one for each tray; with it, the broker keeps messages while "
        "acquisition is away",
    )

    @property
    def has_values(self) -> bool:
        """Return whether topics have values of fans, instead of samples."""
        return bool(self.command_topic or self.speed_key or self.command_key or are_of_each_fan(self.topic))

    @property
    def places(self) -> dict[str, tuple[Topics, str]]:
        """Where the values of fans are: topics and pointer of speed, command and switch."""
        found = {"speed": (self.topic, self.speed_key)}
        found["command"] = (self.command_topic or self.topic, self.command_key)
        if self.switch_topic or self.switch_key:
            found["switch"] = (self.switch_topic or self.command_topic or self.topic, self.switch_key)
        return found

    @property
    def patterns(self) -> tuple[str, ...]:
        """The topics as the configuration has them."""
        topics = [each for each, _ in self.places.values()] if self.has_values else [self.topic]
        return tuple(dict.fromkeys(each if isinstance(each, str) else ", ".join(each) for each in topics))

    @property
    def why_no_commands(self) -> str:
        """Commands need `send_topic`."""
        return "" if self.send_topic else "its source names no send_topic"

    @model_validator(mode="after")
    def _topics_fit(self) -> Self:
        for name in ("topic", "command_topic", "switch_topic", "send_topic"):
            topics: Topics = getattr(self, name)
            for topic in (topics,) if isinstance(topics, str) else topics:
                if has_other_braces(topic):
                    raise ValueError(f"{name}: braces hold the number of the first fan, as in plant/fan{{1}}/rpm")
                if ("+" in topic or "#" in topic) and (self.has_values or name == "send_topic"):
                    raise ValueError(f"{name}: values of fans and commands have topics of their own, without + and #")
        if not self.has_values:
            return self
        if not self.command_topic and not self.command_key:
            raise ValueError("give command_topic, or command_key: without the commands nothing can be judged")
        if self.places["speed"] == self.places["command"]:
            raise ValueError("speed and command are at the same place: give command_topic or command_key")
        if _are_of_each(*self.places["command"]) and not _are_of_each(*self.places["speed"]):
            raise ValueError("topic needs the number of the first fan in braces, as command_topic has it, or a list")
        return self


def _are_of_each(topics: Topics, key: str) -> bool:
    return are_of_each_fan(topics) or is_of_each_fan(key)
