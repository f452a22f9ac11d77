"""Settings of samples from an MQTT broker: `{ kind = "mqtt", url = "mqtt://broker", topic = "plant/tray1" }`."""

from __future__ import annotations

from typing import Literal, Self

from pydantic import Field, model_validator

from fantwin.pipeline.sources.mqtt.settings import BrokerSettings
from fantwin.pipeline.sources.source import SourceConfig

FAN = "{fan}"
"""stands for the number of a fan in a topic"""


class MqttConfig(SourceConfig, BrokerSettings, frozen=True):
    """A broker, and the topics that have the samples: JSON on one topic, or a number for each fan on topics of its own
    (docs/how-to/sources.md)."""

    kind: Literal["mqtt"] = "mqtt"
    topic: str = Field(default="", description="topic of samples in JSON; may have the wildcards + and #")
    speed_topic: str = Field(
        default="",
        description="instead of topic: topic of the speed of a fan as a number; `{fan}` stands for the fan's number",
    )
    command_topic: str = Field(default="", description="with speed_topic: topic of the command of a fan as a number")
    first_fan: int = Field(default=0, ge=0, description="number of the first fan in topics with `{fan}`")
    send_topic: str = Field(
        default="",
        description="topic to which commands of `fantwin command` are sent, as JSON, or with `{fan}` in it as a number "
        "for each fan; without it no commands are sent",
    )
    client_id: str = Field(
        default="",
        description="id of this client, another one for each tray; with it, the broker keeps messages while "
        "acquisition is away",
    )

    @property
    def has_values(self) -> bool:
        """Return whether each topic has a number of one fan."""
        return bool(self.speed_topic)

    @property
    def patterns(self) -> tuple[str, ...]:
        """The topics as the configuration has them."""
        return (self.speed_topic, self.command_topic) if self.has_values else (self.topic,)

    def of_fan(self, topic: str, fan: int) -> str:
        """The topic of a fan of the tray, counted from 0."""
        return topic.replace(FAN, str(self.first_fan + fan))

    @property
    def why_no_commands(self) -> str:
        """Commands need `send_topic`."""
        return "" if self.send_topic else "its source names no send_topic"

    @model_validator(mode="after")
    def _topics_fit(self) -> Self:
        if bool(self.topic) == bool(self.speed_topic or self.command_topic):
            raise ValueError("give topic, for samples in JSON, or speed_topic and command_topic, for numbers")
        if bool(self.speed_topic) != bool(self.command_topic):
            raise ValueError("give speed_topic and command_topic: without the commands nothing can be judged")
        for name in ("speed_topic", "command_topic") if self.has_values else ():
            topic = getattr(self, name)
            if FAN not in topic or "+" in topic or "#" in topic:
                raise ValueError(
                    f"{name} needs {{fan}} for the number of the fan, as in plant/fan{{fan}}/rpm, and no + or #"
                )
        if self.has_values and self.speed_topic == self.command_topic:
            raise ValueError("speed_topic and command_topic are the same")
        if "+" in self.send_topic or "#" in self.send_topic:
            raise ValueError("send_topic: commands go to one topic, without + and #")
        return self
