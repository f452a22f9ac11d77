"""For how long the fans of each tray were judged: what a rate of alarms is relative to.

Of a large site some scores of each tray are decoded, and not every one; so a score stands for the time since the one
before.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from fantwin.schemas.messages import Score
from fantwin.schemas.units import NS_PER_S

LONGEST_STEP_NS = 5 * NS_PER_S
"""between two scores of a stretch; after a longer pause another one begins"""
LONGEST_PERIODS = 3
"""and so long where samples come more slowly than that"""
SAVED_EVERY_NS = 10 * NS_PER_S
LEARNED = "learned"
"""names the twins of a tray that learns them: each version continues the time of the one before"""


@dataclass(frozen=True)
class JudgedStretch:
    """A time in which the fans of a tray were judged by one twin, or by learned ones.

    Attributes:
        fan_ns: judged time, summed over fans.
        declared_per_day: false alarms per fan and day that the twin declares; None: none.
    """

    tray: str
    twin: str
    first_t_ns: int
    last_t_ns: int
    fan_ns: int
    declared_per_day: float | None = None


class JudgedTime:
    """The stretch of each tray that is growing."""

    def __init__(self) -> None:
        self._growing: dict[str, JudgedStretch] = {}
        self._saved_t_ns: dict[str, int] = {}

    def add(self, score: Score, twin: str, declared_per_day: float | None) -> list[JudgedStretch]:
        """A score of a tray has come. twin, declared_per_day: as in JudgedStretch. Returns what is to be kept now."""
        tray, t_ns = score.header.tray, int(score.t_ns[-1])
        before = self._growing.get(tray)
        step_ns = t_ns - before.last_t_ns if before else -1
        longest_ns = max(LONGEST_STEP_NS, LONGEST_PERIODS * score.period_ns)
        if before is None or before.twin != twin or not 0 <= step_ns <= longest_ns:
            self._growing[tray] = JudgedStretch(tray, twin, t_ns, t_ns, 0, declared_per_day)
            self._saved_t_ns[tray] = t_ns
            return [before] if before else []
        fan_ns = before.fan_ns + step_ns * int(np.count_nonzero(score.valid[-1]))
        self._growing[tray] = replace(before, last_t_ns=t_ns, fan_ns=fan_ns)
        if t_ns - self._saved_t_ns[tray] < SAVED_EVERY_NS:
            return []
        self._saved_t_ns[tray] = t_ns
        return [self._growing[tray]]

    def growing(self) -> list[JudgedStretch]:
        """Those that are not over."""
        return list(self._growing.values())
