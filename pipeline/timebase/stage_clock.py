"""Clock of a stage: the host's, or the replay's while a recording is replayed.

Stages with an input use the time of their samples; only sources use the host clock. A replay may be slow, paused or
faster than real time, and a tray must not look silent because of its pace. So ticks carry the time that the replay has
reached. Stages with a source, and stages that serve all trays at once, keep the host's time.

Only the replay session that owns the site sets the time: the one whose health the replayer publishes, while its
liveliness token is there. A replay renews its time 20 times a second, also while it is paused. A time that is not
renewed expires, so nobody can hide a silent line by stopping the clock.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

from fantwin.pipeline.timebase.host_clock import HOST_CLOCK
from fantwin.schemas.messages import Clock

REPLAY = "replay"
"""name of the replayer, used like a stage name in health, liveliness token and producer"""
EXPIRES_S = 5.0
"""a replay's time no longer applies when it has not been renewed for this long"""


def is_of_replay(producer: str) -> bool:
    """Return whether a message comes from a recording, not from a live fan."""
    return producer.startswith(f"{REPLAY}-")


@dataclass(frozen=True, slots=True)
class _ReplayTime:
    """A clock message, and when it was received: by the host's time and by the monotonic clock."""

    clock: Clock
    host_ns: int
    received_s: float


class StageClock:
    """The time of each tray that a stage serves."""

    def __init__(
        self, host_ns: Callable[[], int] = HOST_CLOCK.now_ns, monotonic_s: Callable[[], float] = time.monotonic
    ) -> None:
        self._host_ns = host_ns
        self._monotonic_s = monotonic_s
        self.is_replay_alive = False
        """true while a replay presents the site"""
        self._owner = ""
        """the producer of the replay"""
        self._times: dict[str, _ReplayTime] = {}
        """last clock message of the replay, by tray"""
        self._replayed_until_ns: dict[str, int] = {}
        """host time when the replay was there last, by tray: older samples may be its"""

    def set_replay_alive(self, alive: bool) -> None:
        """The replayer's liveliness token has appeared or gone."""
        self.is_replay_alive = alive
        if not alive:
            self._clear()

    def add_replay_health(self, producer: str, *, has_ended: bool) -> None:
        """A replayer has published health: its session owns the site, unless another owner still renews its time."""
        if has_ended:
            if producer == self._owner:
                self._clear()
        elif not any(self._time_of(tray) for tray in self._times):
            self._owner = producer

    def update(self, clock: Clock) -> bool:
        """A replay has published its time, which from now on applies to that tray; False if it does not own the
        site."""
        if not self.is_replay_alive or clock.header.producer != self._owner:
            return False
        self._replayed_until_ns[clock.header.tray] = self._host_ns()
        self._times[clock.header.tray] = _ReplayTime(clock, self._host_ns(), self._monotonic_s())
        return True

    def tick_ns(self, tray: str) -> int:
        """The time for `tick`: exactly the last time of the replay, never beyond it; otherwise the host's."""
        last = self._time_of(tray)
        return last.clock.t_ns if last else self._host_ns()

    def is_of_replay(self, tray: str) -> bool:
        """Return whether the time of a tray is that of a replay."""
        return self._time_of(tray) is not None

    def now_ns(self, tray: str, t_ns: int) -> int | None:
        """The time against which the age of a sample of t_ns is measured. None where an age has no meaning: in a replay
        that is paused or runs as fast as it can, and of its last samples once it has left."""
        last = self._time_of(tray)
        if last is None:
            was_replayed = t_ns <= self._replayed_until_ns.get(tray, t_ns - 1)
            return None if was_replayed else self._host_ns()
        if last.clock.rate == 0.0 or math.isinf(last.clock.rate):
            return None
        return last.clock.t_ns + round((self._host_ns() - last.host_ns) * last.clock.rate)

    def _time_of(self, tray: str) -> _ReplayTime | None:
        last = self._times.get(tray)
        return last if last and self._monotonic_s() - last.received_s <= EXPIRES_S else None

    def _clear(self) -> None:
        self._times.clear()
        self._owner = ""
