"""Host clock: a step of the wall clock is noticed, and never makes time go back.

Durations come from the monotonic clock; the wall clock only labels them. The time follows the wall clock when that is
set forward. When it is set back by less than a second, the time passes more slowly until the wall clock has caught up.
When it is set back further, the time goes on, ahead of it, until the wall clock is put right.

A site has one time: its launcher hands its own on to each stage that it starts. A stage that is started again after the
wall clock was set back goes on as the others do.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from fantwin.schemas.units import NS_PER_S

VARIABLE = "FANTWIN_HOST_CLOCK"
"""environment variable with the offset of the time to go on with"""
STEP_NS = NS_PER_S  # a larger difference is a clock that was set, not one that was corrected
SLOWER = 100  # by this part of it the time is slower while the wall clock catches up

ONE_MOMENT_NS = NS_PER_S // 1000
READ_ATTEMPTS = 10


@dataclass(frozen=True, slots=True)
class ClockStep:
    """Step of the wall clock. step_ns: by how much, negative if it was set back. at_ns: when, in the time of HostClock.
    ahead_ns: by how much that time is now ahead of the wall clock."""

    step_ns: int
    at_ns: int
    ahead_ns: int


class HostClock:
    """Clock for all threads of a process."""

    def __init__(
        self,
        wall_ns: Callable[[], int] = time.time_ns,
        monotonic_ns: Callable[[], int] = time.monotonic_ns,
        offset_ns: int | None = None,
    ) -> None:
        """offset_ns: `offset_ns` of the clock of another process on this host, to go on with its time; None: begin with
        the wall clock."""
        self._wall_ns = wall_ns
        self._monotonic_ns = monotonic_ns
        self._lock = threading.Lock()
        self._monotonic_last_ns = monotonic_ns()
        self._offset_ns = wall_ns() - self._monotonic_last_ns if offset_ns is None else offset_ns
        self._ahead_ns = 0
        self.steps = 0
        """number of times that the wall clock was set"""
        self.last_step: ClockStep | None = None

    def now_ns(self) -> int:
        """Time in nanoseconds since the epoch, as the wall clock said before it was set back, if it was."""
        with self._lock:
            wall_ns, monotonic_ns = self._read()
            now_ns = monotonic_ns + self._offset_ns
            ahead_ns = now_ns - wall_ns
            step_ns = self._ahead_ns - ahead_ns
            is_set = abs(step_ns) > STEP_NS
            if is_set:
                self._ahead_ns = ahead_ns if ahead_ns > STEP_NS else 0
            if self._ahead_ns:
                self._ahead_ns = ahead_ns  # the wall clock may be corrected while it is behind
            else:
                now_ns = max(wall_ns, now_ns - (monotonic_ns - self._monotonic_last_ns) // SLOWER)
            if is_set:
                self.steps += 1
                self.last_step = ClockStep(step_ns, now_ns, self._ahead_ns)
            self._monotonic_last_ns, self._offset_ns = monotonic_ns, now_ns - monotonic_ns
            return now_ns

    def _read(self) -> tuple[int, int]:
        """Read both clocks at one moment: again if this process was held up in between, which would be taken for a
        step."""
        attempt = 0
        while True:
            attempt += 1
            before_ns, wall_ns, monotonic_ns = self._monotonic_ns(), self._wall_ns(), self._monotonic_ns()
            if monotonic_ns - before_ns <= ONE_MOMENT_NS or attempt == READ_ATTEMPTS:
                return wall_ns, monotonic_ns

    @property
    def offset_ns(self) -> int:
        """The time now less the monotonic clock, which all processes of a host share."""
        self.now_ns()
        return self._offset_ns


def handed_on(environment: Mapping[str, str]) -> int | None:
    """Offset of the time that the parent of this process has handed on; None if there is none."""
    try:
        return int(environment[VARIABLE])
    except (KeyError, ValueError):
        return None


HOST_CLOCK = HostClock(offset_ns=handed_on(os.environ))
"""clock of this process"""
