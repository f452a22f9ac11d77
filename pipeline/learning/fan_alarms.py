"""Which fans of a tray have an alarm, by their scores.

The state of a score is UNKNOWN where a sample is invalid, and STOPPED or STARTING while a fan is idle, although its
alarm is still active. Such states say nothing about the alarm.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fantwin.schemas.enums import FanState
from fantwin.schemas.messages import Array, Score
from fantwin.schemas.units import NS_PER_S
from fantwin.scoring.samples import among

WITH_ALARM = (FanState.ALARM, FanState.RETURNING)
WITHOUT_ALARM = (FanState.NORMAL, FanState.SUSPECT)
IDLE = (FanState.STOPPED, FanState.STARTING)
LONGEST_UNKNOWN_NS = 600 * NS_PER_S
"""of scores: a fan whose alarm is still not known is out of use, and nothing waits for it"""


@dataclass(frozen=True, eq=False)
class ScoredAlarms:
    """What a score says about alarms and about the times at which fans were judged."""

    began_t_ns: list[int]
    """when alarms of fans began"""
    had_alarm: bool
    """a fan had an alarm at some row"""
    judged_t_ns: Array
    """(rows,) ns since 1970, rising: some fan was judged, or was idle"""


class FanAlarms:
    """The fans of a tray that have an alarm now."""

    def __init__(self, fans: int) -> None:
        self._has_alarm = np.zeros(fans, np.bool_)
        self._is_known = np.zeros(fans, np.bool_)
        self._first_t_ns: int | None = None
        """of the first row at which some fan was judged"""
        self._waited_ns = 0
        """time since then"""

    @property
    def fans(self) -> list[int]:
        """Those with an alarm."""
        return np.flatnonzero(self._has_alarm).tolist()

    @property
    def are_known(self) -> bool:
        """Whether the scores have said of each fan whether it has an alarm, or of some fans for long enough."""
        return bool(self._is_known.all()) or self._waited_ns >= LONGEST_UNKNOWN_NS

    def update(self, score: Score) -> ScoredAlarms:
        """Process a score that has samples."""
        with_alarm = among(score.state, *WITH_ALARM)
        is_known = with_alarm | among(score.state, *WITHOUT_ALARM)
        has_alarm = _last_known(with_alarm, is_known, self._has_alarm)
        was_known = np.vstack((self._is_known, self._is_known | np.logical_or.accumulate(is_known)[:-1]))
        before = np.vstack((self._has_alarm, has_alarm[:-1]))
        began = (has_alarm & ~before & was_known).sum(axis=1)  # others may have begun before a restart
        self._has_alarm = has_alarm[-1].copy()
        self._is_known |= is_known.any(axis=0)
        self._wait(score.t_ns[is_known.any(axis=1)])
        judged = (is_known | among(score.state, *IDLE)).any(axis=1)
        return ScoredAlarms(np.repeat(score.t_ns, began).tolist(), bool(has_alarm.any()), score.t_ns[judged])

    def _wait(self, known_t_ns: Array) -> None:
        if len(known_t_ns):
            if self._first_t_ns is None:
                self._first_t_ns = int(known_t_ns[0])
            self._waited_ns = int(known_t_ns[-1]) - self._first_t_ns


def _last_known(flags: Array, is_known: Array, before: Array) -> Array:
    """(n, fans) at each row the flag of the newest row up to it that is known; `before` (fans,) if there is none."""
    rows = np.where(is_known, np.arange(len(flags))[:, np.newaxis], -1)
    newest = np.maximum.accumulate(rows, axis=0)
    return np.where(newest < 0, before, np.take_along_axis(flags, np.maximum(newest, 0), axis=0))
