"""A clock that passes only by waiting, and a bus that remembers, for tests of what plays a recording."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from fantwin.pipeline.replay.live.player import BEAT_S
from fantwin.schemas.enums import StageStatus
from fantwin.schemas.envelope import Envelope
from tests.support.replay_data import START_NS


@dataclass
class FakeTime:
    """Passes only by waiting. `until_s`: when the end is asked for."""

    s: float = 50.0
    until_s: float = math.inf
    waits: int = 0

    def now_s(self) -> float:
        return self.s

    def wait(self, for_s: float) -> bool:
        self.waits += 1
        assert for_s <= BEAT_S
        self.s = min(self.s + (max(for_s, 1e-9) if for_s else 0.0), self.until_s)  # never too little for a float
        return self.s >= self.until_s


@dataclass
class Sent:
    """Remembers which messages were sent, and when."""

    time: FakeTime
    messages: list[tuple[float, str, int]] = field(default_factory=list)
    clocks: list[tuple[float, int, float]] = field(default_factory=list)
    healths: list[float] = field(default_factory=list)
    order: list[str] = field(default_factory=list)
    cost_s: float = 0.0

    def send(self, entry: Envelope) -> None:
        self.order.append("message")
        self.messages.append((round(self.time.s - 50.0, 6), entry.topic, entry.message.header.sequence))
        self.time.s += self.cost_s

    def publish_clock(self, t_ns: int, rate: float) -> None:
        self.order.append("clock")
        self.clocks.append((self.time.s - 50.0, t_ns - START_NS, rate))

    def publish_health(self, status: StageStatus = StageStatus.OK, problem: str = "") -> None:
        self.healths.append(self.time.s - 50.0)
