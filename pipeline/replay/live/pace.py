"""When a recorded message is due: recorded time against the host's clock, at any rate and without drift."""

from __future__ import annotations

import math

from fantwin.schemas.units import NS_PER_S

SLOWEST, FASTEST = 1 / 64, 1024.0
"""limits of doubling and halving the rate; faster than FASTEST is only infinite: as fast as possible"""


class Pace:
    """Maps a monotonic clock, which the caller reads as `now_s`, to recorded time.

    Deadlines count from the last change of the rate, so that delays between messages do not add up.
    """

    def __init__(self, rate: float, *, paused: bool = False) -> None:
        """`rate`: seconds of the recording per second; infinite: as fast as possible."""
        self.rate = rate
        self.paused = paused
        self.paused_s = 0.0
        """time spent paused, up to the last change"""
        self._at_ns = 0
        self._since_s = 0.0

    @property
    def rate_now(self) -> float:
        """The rate to publish: 0 while paused."""
        return 0.0 if self.paused else self.rate

    def start(self, at_ns: int, now_s: float) -> None:
        """Set recorded time to `at_ns` now."""
        self._at_ns, self._since_s = at_ns, now_s

    def change(self, at_ns: int, now_s: float, *, rate: float | None = None, paused: bool | None = None) -> None:
        """Continue from `at_ns` with another rate, or pause there."""
        if self.paused:
            self.paused_s += now_s - self._since_s
        self.rate = self.rate if rate is None else rate
        self.paused = self.paused if paused is None else paused
        self.start(at_ns, now_s)

    def position_ns(self, now_s: float, next_ns: int) -> int:
        """Recorded time now, at most `next_ns`, the time of the next message."""
        if self.paused:
            return min(self._at_ns, next_ns)
        if math.isinf(self.rate):
            return next_ns
        return min(self._at_ns + round((now_s - self._since_s) * self.rate * NS_PER_S), next_ns)

    def due_in_s(self, t_ns: int, now_s: float) -> float:
        """Seconds until recorded time is `t_ns`; zero or less: it is due. Infinite while paused."""
        if self.paused:
            return math.inf
        return (t_ns - self._at_ns) / NS_PER_S / self.rate - (now_s - self._since_s)


def faster(rate: float) -> float:
    """Twice the rate."""
    return math.inf if rate >= FASTEST else rate * 2


def slower(rate: float) -> float:
    """Half the rate."""
    return FASTEST if math.isinf(rate) else max(rate / 2, SLOWEST)
