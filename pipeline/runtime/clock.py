"""What time it is for a stage: the host's, or that of a replay for as long as one is there.

A stage that makes data of data goes by the time of the data. While a recording is replayed, slowly, paused or faster
than time, the line must not look silent because the replay is; so its ticks bear the time the replay has come to.
Stages with a device of their own, and those that serve all trays at once (people, disks), stay with the host's time.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable

from schemas.messages import Clock

REPLAY = "replay"
"""name of the replayer, as that of a stage, in its health, its liveliness token and its session ids"""


def is_of_replay(producer: str) -> bool:
    """Whether a message comes from a recording, and not from a fan of today."""
    return producer.startswith(f"{REPLAY}-")


class StageClock:
    """The time of each tray that a stage serves."""

    def __init__(self, host_ns: Callable[[], int] = time.time_ns) -> None:
        self._host_ns = host_ns
        self._told: dict[str, tuple[Clock, int]] = {}
        """of each tray: what the replay said last, and when that was received, in the host's time"""

    def note(self, clock: Clock, received_t_ns: int) -> None:
        """A replay has said what it has come to: from now on its time is in force for that tray."""
        self._told[clock.header.tray] = (clock, received_t_ns)

    def forget(self) -> None:
        """The replay has left: the host's time is in force again."""
        self._told.clear()

    def tick_ns(self, tray: str) -> int:
        """The time for `tick`: exactly what the replay said last, never beyond it."""
        told = self._told.get(tray)
        return told[0].t_ns if told else self._host_ns()

    def now_ns(self, tray: str) -> int | None:
        """The time against which the age of a sample is told; None in a replay that stands still, or goes as fast as it
        can: there an age says nothing."""
        told = self._told.get(tray)
        if told is None:
            return self._host_ns()
        clock, since_ns = told
        if clock.rate == 0.0 or math.isinf(clock.rate):
            return None
        return clock.t_ns + round((self._host_ns() - since_ns) * clock.rate)
