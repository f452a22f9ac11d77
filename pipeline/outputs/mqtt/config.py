"""Section `[mqtt]`."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from fantwin.pipeline.config.models import Name
from fantwin.pipeline.runtime.stage import StageConfig
from fantwin.pipeline.site.request_form import OperatorAction
from fantwin.pipeline.sources.mqtt.settings import BrokerSettings

TopicPrefix = Annotated[str, Field(pattern=r"^[^+#$/\x00-\x1f][^+#\x00-\x1f]*[^+#/\x00-\x1f]$|^[^+#$/\x00-\x1f]$")]


class MqttConfig(StageConfig, BrokerSettings, frozen=True):  # pyright: ignore[reportGeneralTypeIssues]  both are frozen
    """The broker, what may be asked, and what Home Assistant shows."""

    prefix: TopicPrefix = Field(default="fantwin", description="first part of all topics: PREFIX/SITE/TRAY/FAN/state")
    accept: tuple[OperatorAction, ...] = Field(
        default=(), description="actions that may be requested by MQTT; by default none, and no request is read"
    )
    operator_name: Annotated[str, Field(pattern=r"^[^\x00-\x1f]*$", max_length=64)] = Field(
        default="",
        description='required with accept: recorded as "mqtt:NAME" with each request, since a broker does not say who '
        "sent a message",
    )
    home_assistant: Literal["off", "publish", "remove"] = Field(
        default="off", description="publish: fans become devices in Home Assistant; remove: these devices are removed"
    )
    home_assistant_trays: tuple[Name, ...] = Field(
        default=(), description="trays whose fans become devices; empty: all"
    )
    home_assistant_fans: int = Field(
        default=64, ge=0, le=10_000, description="how many fans at most become devices, with 5 entities each"
    )

    @model_validator(mode="after")
    def _check(self) -> Self:
        if bool(self.accept) != bool(self.operator_name):
            raise ValueError("accept and operator_name belong together: give both, or neither")
        return self
