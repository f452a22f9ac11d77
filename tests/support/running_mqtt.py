"""The stage `mqtt` with its real connection, fed with messages."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from pipeline.broker.config import MqttConfig
from pipeline.config.models import TrayConfig
from pipeline.runtime.stage import Context
from schemas.envelope import Envelope
from schemas.header import Header
from schemas.messages import Alarm, Message, Request, Score
from schemas.topics import tray_key
from stages.mqtt import MqttCore, build

SITE, TRAY, FANS = "hall", "tray1", 4
PRODUCER = "mqtt-all-0123"
ROOT = f"fantwin/{SITE}"
TICK_S = 0.02
SECONDS_A_TICK = 1
"""of the time that the core is given"""


class RunningMqtt:
    """answer: what the scorer says to a request; the answers are passed back as the bus would."""

    def __init__(
        self,
        folder: Path,
        port: int,
        answer: Callable[[Request], list[Alarm]] = lambda _request: [],
        fans: int = FANS,
        **settings: Any,
    ) -> None:
        config = MqttConfig.model_validate({"host": "127.0.0.1", "port": port} | settings)
        trays = (TrayConfig(name=TRAY, fans=fans, speed_unit="rpm"),)
        built = build(Context(SITE, trays, config, folder, folder, 0, producer=PRODUCER))
        assert isinstance(built.core, MqttCore)
        self.core = built.core
        self.sent: list[Request] = []
        self._answer = answer
        self._lock = threading.Lock()
        self._ended = threading.Event()
        self._now_ns = 0
        self._thread = threading.Thread(target=self._tick, daemon=True)
        self._thread.start()

    def feed(self, *messages: Message) -> None:
        """Pass messages to the core as the runner does: scores as envelopes."""
        with self._lock:
            for message in messages:
                is_score = isinstance(message, Score)
                self.core.step(Envelope.of(tray_key(SITE, TRAY, "score"), message, 0) if is_score else message)

    def problem(self) -> str:
        with self._lock:
            return self.core.problem()

    def counters(self) -> dict[str, int]:
        with self._lock:
            return dict(self.core.counters())

    def kill(self) -> None:
        """Nothing is sent any more, as if the process had died: the connection stays."""
        self._ended.set()
        self._thread.join()

    def close(self) -> None:
        self.kill()
        self.core.close()

    def _tick(self) -> None:
        while not self._ended.wait(TICK_S):
            with self._lock:
                self._now_ns += SECONDS_A_TICK * 1_000_000_000
                for message in self.core.tick(self._now_ns):
                    assert isinstance(message, Request)
                    name = f"{PRODUCER}/{len(self.sent)}"
                    self.sent.append(message)
                    for number, alarm in enumerate(self._answer(message)):
                        header = Header("scorer-all-1", 900 + 10 * len(self.sent) + number, TRAY)
                        self.core.step(replace(alarm, request=name, header=header))
