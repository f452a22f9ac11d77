"""The stage `mqtt` with its real connection, fed with messages."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from fantwin.pipeline.outputs.mqtt.config import MqttConfig
from fantwin.stages.mqtt import STAGE, MqttCore
from tests.support.running_core import FANS, SITE, Answer, Fans, RunningCore

ROOT = f"fantwin/{SITE}"


class RunningMqtt(RunningCore[MqttCore]):
    """It publishes under ROOT to the broker at `port`."""

    def __init__(
        self, folder: Path, port: int, answer: Answer | None = None, fans: Fans = FANS, **settings: Any
    ) -> None:
        config = MqttConfig.model_validate({"url": f"mqtt://127.0.0.1:{port}"} | settings)
        super().__init__(STAGE, config, folder, answer, fans)
