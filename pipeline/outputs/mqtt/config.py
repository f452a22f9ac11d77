"""Section `[mqtt]`."""

from __future__ import annotations

from pydantic import Field

from fantwin.pipeline.config.settings import Name
from fantwin.pipeline.runtime.stage import StageConfig
from fantwin.pipeline.site.request_desk import OperatorAction
from fantwin.pipeline.sources.mqtt.connection import BrokerSettings


class MqttConfig(StageConfig, BrokerSettings, frozen=True):  # pyright: ignore[reportGeneralTypeIssues]  both are frozen
    """The broker, what may be asked, and what Home Assistant shows."""

    accept: tuple[OperatorAction, ...] = Field(
        default=(), description="actions that may be requested by MQTT; by default none, and no request is read"
    )
    home_assistant: tuple[Name, ...] = Field(
        default=(), description="trays whose fans become devices in Home Assistant; by default none"
    )
