"""When a message of a recording is due, at any rate: recorded time against the host's, without drift."""

from __future__ import annotations

import math

from schemas.units import NS_PER_S

SLOWEST, FASTEST = 1 / 64, 1024.0
"""the rates that doubling and halving stay within; beyond the fastest there is only `as fast as it goes`"""


class Pace:
    """Goes through recorded time. `now_s` is a monotonic clock that the caller reads.

    Deadlines count from where the pace was last changed, so that no pause between two messages adds up.
    """

    def __init__(self, rate: float, *, paused: bool = False) -> None:
        """`rate`: seconds of the recording a second, infinite for as fast as it goes."""
        self.rate = rate
        self.paused = paused
        self.paused_s = 0.0
        """how long it has been paused, up to the last change"""
        self._at_ns = 0
        self._since_s = 0.0

    @property
    def rate_now(self) -> float:
        """The rate as the clock tells it: 0 while paused."""
        return 0.0 if self.paused else self.rate

    def start(self, at_ns: int, now_s: float) -> None:
        """Recorded time `at_ns` is now."""
        self._at_ns, self._since_s = at_ns, now_s

    def change(self, at_ns: int, now_s: float, *, rate: float | None = None, paused: bool | None = None) -> None:
        """Go on from `at_ns` at another rate, or not at all."""
        if self.paused:
            self.paused_s += now_s - self._since_s
        self.rate = self.rate if rate is None else rate
        self.paused = self.paused if paused is None else paused
        self.start(at_ns, now_s)

    def position_ns(self, now_s: float, next_ns: int) -> int:
        """What recorded time is now, never beyond `next_ns`, that of the message which is next."""
        if self.paused:
            return min(self._at_ns, next_ns)
        if math.isinf(self.rate):
            return next_ns
        return min(self._at_ns + round((now_s - self._since_s) * self.rate * NS_PER_S), next_ns)

    def due_in_s(self, t_ns: int, now_s: float) -> float:
        """How long until recorded time is `t_ns`; not positive: it is due. Infinite while paused."""
        if self.paused:
            return math.inf
        return (t_ns - self._at_ns) / NS_PER_S / self.rate - (now_s - self._since_s)


def faster(rate: float) -> float:
    """Twice the rate."""
    return math.inf if rate >= FASTEST else rate * 2


def slower(rate: float) -> float:
    """Half the rate."""
    return FASTEST if math.isinf(rate) else max(rate / 2, SLOWEST)
