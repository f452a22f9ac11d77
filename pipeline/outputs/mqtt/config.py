"""Section `[mqtt]`."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from fantwin.pipeline.config.settings import Name
from fantwin.pipeline.runtime.stage import StageConfig
from fantwin.pipeline.site.request_desk import OperatorAction
from fantwin.pipeline.sources.mqtt.settings import BrokerSettings


class MqttConfig(StageConfig, BrokerSettings, frozen=True):  # pyright: ignore[reportGeneralTypeIssues]  both are frozen
    """The broker, what may be asked, and what Home Assistant shows."""

    accept: tuple[OperatorAction, ...] = Field(
        default=(), description="actions that may be requested by MQTT; by default none, and no request is read"
    )
    home_assistant: Literal["off", "publish"] = Field(
        default="off", description="publish: fans become devices in Home Assistant"
    )
    home_assistant_trays: tuple[Name, ...] = Field(
        default=(), description="trays whose fans become devices, all of them; empty: the first 64 fans of all trays"
    )
