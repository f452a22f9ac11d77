"""Settings of samples from an MQTT broker: `{ kind = "mqtt", url = "mqtt://broker", topic = "plant/tray1" }`."""

from __future__ import annotations

import re
from typing import Literal, Self

from pydantic import Field, model_validator

from fantwin.pipeline.sources.mqtt.connection import BrokerSettings
from fantwin.pipeline.sources.source import SourceConfig

_FAN = re.compile(r"\{(\d+)\}")
"""the place of the number of a fan in a topic, with that of the tray's first fan"""


def is_of_each_fan(topic: str) -> bool:
    """Whether each fan has a topic of its own."""
    return _FAN.search(topic) is not None


def of_fan(topic: str, fan: int) -> str:
    """The topic of a fan of the tray, counted from 0."""
    return _FAN.sub(lambda first: str(int(first[1]) + fan), topic)


class MqttConfig(SourceConfig, BrokerSettings, frozen=True):
    """A broker, and the topics that have the samples: JSON on one topic, or a number for each fan on topics of its own
    (docs/how-to/sources.md)."""

    kind: Literal["mqtt"] = "mqtt"
    topic: str = Field(
        min_length=1,
        description="topic of samples in JSON, which may have the wildcards + and #; or of the speed of a fan as a "
        "number: then the number of the first fan is in braces, plant/fan{1}/rpm",
    )
    command_topic: str = Field(
        default="", description="topic of the command of a fan as a number, where topic is that of its speed"
    )
    send_topic: str = Field(
        default="",
        description="topic to which commands of `fantwin command` are sent, as JSON, or as a number for each fan if it "
        "has the first one's in braces; without it no commands are sent",
    )
    client_id: str = Field(
        default="",
        description="id of this client, another one for each tray; with it, the broker keeps messages while "
        "acquisition is away",
    )

    @property
    def has_values(self) -> bool:
        """Return whether each topic has a number of one fan."""
        return is_of_each_fan(self.topic)

    @property
    def patterns(self) -> tuple[str, ...]:
        """The topics as the configuration has them."""
        return (self.topic, self.command_topic) if self.has_values else (self.topic,)

    @property
    def why_no_commands(self) -> str:
        """Commands need `send_topic`."""
        return "" if self.send_topic else "its source names no send_topic"

    @model_validator(mode="after")
    def _topics_fit(self) -> Self:
        for name in ("topic", "command_topic", "send_topic"):
            if set("{}") & set(_FAN.sub("", getattr(self, name))):
                raise ValueError(f"{name}: braces hold the number of the first fan, as in plant/fan{{1}}/rpm")
        if self.has_values and not self.command_topic:
            raise ValueError("give command_topic: without the commands nothing can be judged")
        for name in ("topic", "command_topic") if self.command_topic else ():
            topic = getattr(self, name)
            if not is_of_each_fan(topic) or "+" in topic or "#" in topic:
                raise ValueError(
                    f"{name} needs the number of the first fan in braces, as in plant/fan{{1}}/rpm, and no + or #"
                )
        if self.topic == self.command_topic:
            raise ValueError("topic and command_topic are the same")
        if "+" in self.send_topic or "#" in self.send_topic:
            raise ValueError("send_topic: commands go to one topic, without + and #")
        return self
