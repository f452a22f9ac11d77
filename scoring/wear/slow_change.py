"""Slow change of a fan against the fans beside it: a notice, long before it is wear that reaches a limit.

The change of a fan is the mean of its last points less the mean of its first. The weather, the supply and the room act
on all fans of a tray, so the median change of those that were first measured with it is subtracted. A change is noticed
where what is left is large, and far beyond the scatter of the points.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from schemas.messages import Array
from schemas.units import NS_PER_S

if TYPE_CHECKING:  # it loads scipy, which a command that shows alarms does not need
    from scoring.wear.trend import WearSeries

WEAR_HINT = "see fantwin wear"
"""each notice ends with it"""
MIN_CHANGE = 0.03
"""relative; smaller changes are those of any healthy fan"""
MIN_SCATTERS = 5.0
MEAN_OF = 2
"""points at either end"""
MIN_POINTS = 2 * MEAN_OF
STD_PER_DIFFERENCE = 1.4826 / np.sqrt(2.0)
"""standard deviation of points from the median size of their successive differences"""
BESIDE_NS = 1800 * NS_PER_S
"""fans are compared whose first points are at most so far apart"""


def slow_changes(parameter: str, series: Sequence[WearSeries]) -> list[str]:
    """A line for each fan that has changed slowly, as its relative parameter shows. series: of each fan."""
    points = {fan: each.snapshot() for fan, each in enumerate(series) if len(each) >= MIN_POINTS}
    values = {fan: np.asarray(of_fan["value"], np.float64) for fan, of_fan in points.items()}
    changes = {fan: _change(value) for fan, value in values.items()}
    lines = []
    for fan in (fan for fan, change in changes.items() if abs(change) >= MIN_CHANGE):
        t_ns, value = points[fan]["t_ns"], values[fan]
        beside = [
            changes[other]
            for other, of_other in points.items()
            if other != fan and abs(of_other["t_ns"][0] - t_ns[0]) <= BESIDE_NS
        ]
        others = float(np.median(beside)) if beside else 0.0
        if abs(changes[fan] - others) < max(MIN_CHANGE, MIN_SCATTERS * _scatter(value)):
            continue
        over = _span((t_ns[-1] - t_ns[0]) / NS_PER_S)
        compared = f", the fans beside it {100 * others:+.1f} %" if beside else ""
        lines.append(f"fan {fan}: {parameter} {100 * changes[fan]:+.1f} % over {over}{compared}: {WEAR_HINT}")
    return lines


def _change(value: Array) -> float:
    return float(value[-MEAN_OF:].mean() - value[:MEAN_OF].mean())


def _scatter(value: Array) -> float:
    """Standard deviation of a mean of points, apart from slow change."""
    return float(STD_PER_DIFFERENCE * np.median(np.abs(np.diff(value)))) / np.sqrt(MEAN_OF)


def _span(seconds: float) -> str:
    for name, size in (("days", 86_400.0), ("h", 3600.0)):
        if seconds >= 2.0 * size:
            return f"{seconds / size:.0f} {name}"
    return f"{seconds / 60.0:.0f} min"
