"""The time that a stage uses: the host's, or the replay's while a recording is replayed.

Stages with an input use the time of their samples; only sources use the host clock. A replay may be slow, paused or
faster than real time, and a tray must not look silent because of its pace. So ticks carry the time that the replay has
reached. Stages with a source, and stages that serve all trays at once, keep the host's time.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable

from schemas.messages import Clock

REPLAY = "replay"
"""name of the replayer, used like a stage name in health, liveliness token and producer"""


def is_of_replay(producer: str) -> bool:
    """Whether a message comes from a recording, not from a live fan."""
    return producer.startswith(f"{REPLAY}-")


class StageClock:
    """The time of each tray that a stage serves."""

    def __init__(self, host_ns: Callable[[], int] = time.time_ns) -> None:
        self._host_ns = host_ns
        self._replay: dict[str, tuple[Clock, int]] = {}
        """by tray: the last clock message of a replay, and the host time at which it was received"""

    def update(self, clock: Clock, received_t_ns: int) -> None:
        """A replay has published its time, which from now on applies to that tray."""
        self._replay[clock.header.tray] = (clock, received_t_ns)

    def clear(self) -> None:
        """The replay has left: the host's time applies again."""
        self._replay.clear()

    def tick_ns(self, tray: str) -> int:
        """The time for `tick`: exactly the last time of the replay, never beyond it; otherwise the host's."""
        last = self._replay.get(tray)
        return last[0].t_ns if last else self._host_ns()

    def now_ns(self, tray: str) -> int | None:
        """The time against which the age of a sample is measured. None in a replay that is paused or runs as fast as it
        can: an age has no meaning there."""
        last = self._replay.get(tray)
        if last is None:
            return self._host_ns()
        clock, received_ns = last
        if clock.rate == 0.0 or math.isinf(clock.rate):
            return None
        return clock.t_ns + round((self._host_ns() - received_ns) * clock.rate)
