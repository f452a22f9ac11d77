"""Slow change of a fan against the fans beside it: a notice, long before it is wear that reaches a limit.

The change of a fan is that of its trend line over the time observed (scoring.wear.trend). The weather, the supply and
the room act on all fans of a tray, so the median change of those that were first measured with it is subtracted. A
change is noticed where it and this difference are at least `MIN_CHANGE` and at least twice the half-width of the 95 %
interval. The limit is wide because every fan is tested again with every point, and a healthy fan must not be named.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from schemas.units import NS_PER_S

if TYPE_CHECKING:  # it loads scipy, which a command that shows alarms does not need
    from scoring.wear.trend import Trend

WEAR_HINT = "see fantwin wear"
"""each notice ends with it"""
MOST_FANS = "most fans turn"
"""the line on a change that the fans of a tray share begins with it (scoring.wear.followed)"""
MIN_CHANGE = 0.03
"""relative; smaller changes are those of any healthy fan"""
MIN_INTERVALS = 2.0
BESIDE_NS = 1800 * NS_PER_S
"""fans are compared whose first points are at most so far apart"""
HOURS_PER_DAY = 24.0


def is_of_slow_change(note: str) -> bool:
    """Whether a note of a scorer is about fans that change slowly, one of them or most of a tray."""
    return note.endswith(WEAR_HINT) or note.startswith(MOST_FANS)


def slow_changes(parameter: str, trends: Sequence[Trend | None]) -> list[str]:
    """A line for each fan that has changed slowly, as its relative parameter shows. trends: of each fan."""
    known = {fan: trend for fan, trend in enumerate(trends) if trend is not None}
    lines = []
    for fan, trend in known.items():
        beside = [each for other, each in known.items() if other != fan and _begin_together(each, trend)]
        change, half_interval = _of_line(trend)
        others, others_half = np.median([_of_line(each) for each in beside], axis=0) if beside else (0.0, 0.0)
        least = max(MIN_CHANGE, MIN_INTERVALS * float(np.hypot(half_interval, others_half)))
        if min(abs(change), abs(change - others)) < least:
            continue
        compared = f", the fans beside it {_percent(others)}" if beside else ""
        lines.append(f"fan {fan}: {parameter} {_over_time(change, trend.days)}{compared}: {WEAR_HINT}")
    return lines


def _begin_together(one: Trend, other: Trend) -> bool:
    return abs(one.first_ns - other.first_ns) <= BESIDE_NS


def _of_line(trend: Trend) -> tuple[float, float]:
    """The change of the line over the time observed, and half its 95 % interval."""
    return trend.slope_per_day * trend.days, trend.t_quantile * trend.slope_error * trend.days


def _over_time(change: float, days: float) -> str:
    unit, each, times = ("days", "a day", days) if days >= 2.0 else ("h", "an hour", days * HOURS_PER_DAY)
    return f"{_percent(change)} in {times:.{_places(times)}f} {unit}, {_percent(change / times)} {each}"


def _percent(share: float) -> str:
    return f"{100 * share:+.{_places(100 * share)}f} %"


def _places(value: float) -> int:
    """For two digits at least."""
    return 2 if abs(value) < 1.0 else 1 if abs(value) < 10.0 else 0
