"""The methods compared: a method is a name, a detector for each run, and a limit that is fixed or set by the bench.

A *detector* is handed the predictions of one tray's run block by block, as the scorer is, and gives for each
block a score (n, fans), NaN where it has none, and the alarms it raised and cleared. A method that only has a score
gets its alarms from `Limited`; the limit is set for all of them by one rule on the same healthy runs (`Calibration`).
The scorer itself (`ours`) decides by the rate declared in the twin's card, and raises its own alarms.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from bench.detection.metrics import RaisedAlarm
from fantwin.schemas.messages import Array, Prediction

OFF_DELAY_S = 1.0
"""an alarm of a limit clears after the score has been below the limit for this time"""
WINDOW_S = 60.0
"""excursions of a fan within this time count as one when a limit is set"""


@dataclass(frozen=True)
class AlarmChange:
    """An alarm of a fan was raised or cleared, or its causes were reported; the most probable cause is the first."""

    fan: int
    t_ns: int
    raised: bool
    causes: tuple[str, ...] = ()


@dataclass(frozen=True)
class MethodOutput:
    """The output of a detector for a block. score: (n, fans)."""

    score: Array
    changes: list[AlarmChange]


class Scores(Protocol):
    """A score that depends on past samples; the larger, the less healthy."""

    def take(self, block: Prediction) -> Array:
        """(n, fans), NaN where a sample has no score."""
        ...


class Detector(Protocol):
    """Scores and alarms of one run."""

    def take(self, block: Prediction) -> MethodOutput:
        """Score a block; blocks come in order of time."""
        ...


@dataclass
class Method:
    """One method. limit: None until it is set; is_fixed: the limit comes with the method and is not set."""

    name: str
    scores: Callable[[int], Scores]
    """makes the scores of one run, given its number of fans"""
    limit: float | None = None
    is_fixed: bool = False
    every: int = 1
    """scores only one fan in this many, for methods that are too slow for all"""

    def detector(self, fans: int) -> Detector:
        """A new detector for a run."""
        assert self.limit is not None, self.name
        return Limited(self.scores(fans), fans, self.limit)


class Limited:
    """Alarms of a score: raised above the limit, over once it was below for OFF_DELAY_S."""

    def __init__(self, scores: Scores, fans: int, limit: float) -> None:
        self._scores = scores
        self._limit = limit
        self._row = 0
        self._last = np.full(fans, np.iinfo(np.int64).min // 2)
        self._was_active = np.zeros(fans, np.bool_)

    def take(self, block: Prediction) -> MethodOutput:
        """See Detector."""
        score: Array = self._scores.take(block)
        rows = np.arange(self._row, self._row + len(score))[:, np.newaxis]
        self._row += len(score)
        exceeds = score > self._limit  # NaN does not
        if not exceeds.any() and not self._was_active.any():
            return MethodOutput(score, [])
        last = np.maximum.accumulate(np.where(exceeds, rows, self._last), axis=0)
        self._last = last[-1]
        active = rows - last <= round(OFF_DELAY_S * 1e9 / block.period_ns)
        before = np.concatenate((self._was_active[np.newaxis], active[:-1]))
        self._was_active = active[-1]
        changed = zip(*np.nonzero(active != before), strict=True)
        return MethodOutput(
            score, [AlarmChange(int(fan), int(block.t_ns[row]), bool(active[row, fan])) for row, fan in changed]
        )


class Calibration:
    """Sets a limit: the smallest that gives no more false alarms on the healthy runs than the budget allows.

    Where it allows less than one, that is the largest score seen. Excursions count by windows of WINDOW_S of a fan.
    """

    def __init__(self, alarms_per_hour: float) -> None:
        """alarms_per_hour: of a fan."""
        self._alarms_per_hour = alarms_per_hour
        self._windows: dict[tuple[str, int], Array] = {}
        self._scored_ns = 0

    def take(self, run: str, block: Prediction, score: Array) -> None:
        """Note the scores of a block of a run, (n, fans)."""
        scored = np.isfinite(score)
        self._scored_ns += int(scored.sum()) * block.period_ns
        window = (run, int(block.t_ns[0] // round(WINDOW_S * 1e9)))
        largest: Array = np.max(np.where(scored, score, -np.inf), axis=0)
        before = self._windows.get(window)
        self._windows[window] = largest if before is None else np.maximum(before, largest)

    @property
    def fan_hours(self) -> float:
        """How long fans had a score."""
        return self._scored_ns / 3.6e12

    @property
    def allowed(self) -> int:
        """How many false alarms the budget allows on these runs."""
        return int(self._alarms_per_hour * self.fan_hours)

    def limit(self) -> float:
        """The limit; a score must be above it."""
        falling = -np.sort(-np.concatenate(list(self._windows.values())))
        return float(falling[min(self.allowed, len(falling) - 1)])


class Log:
    """The alarms of a method, run by run."""

    def __init__(self) -> None:
        self._closed: list[RaisedAlarm] = []
        self._open: dict[tuple[str, int], RaisedAlarm] = {}

    def take(self, run: str, changes: list[AlarmChange]) -> None:
        """Note what changed in a run."""
        for change in changes:
            place = (run, change.fan)
            standing = self._open.get(place)
            if change.raised:
                raised_ns = standing.raised_ns if standing else change.t_ns
                causes = change.causes or (standing.causes if standing else ())
                self._open[place] = RaisedAlarm(run, change.fan, raised_ns, None, causes)
            elif standing:
                self._closed.append(replace(self._open.pop(place), cleared_ns=change.t_ns))

    @property
    def alarms(self) -> list[RaisedAlarm]:
        """All alarms; active ones have no time of clearing."""
        return [*self._closed, *self._open.values()]
