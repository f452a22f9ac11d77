"""scoring.wear.slow_change: a fan that changes against the fans beside it is noticed, and weather is not."""

from __future__ import annotations

import numpy as np

from scoring.wear.slow_change import slow_changes
from scoring.wear.trend import Trend, WearSeries

EVERY_NS = 600 * 10**9
POINTS = 19
"""three hours"""
ERRORS = (0.02, 0.03, 0.1, 0.03, 0.4, 0.02, 2.0)
"""of a 4-pin fan under a thermostat: at its minimum speed the drag is hardly determined"""


def trend_of(growth: float, seed: int, points: int = POINTS, first: int = 0) -> Trend | None:
    made = WearSeries()
    noise = np.random.default_rng(seed).normal(0.0, 0.003, points)
    for number in range(points):
        made.add((1000 + first + number) * EVERY_NS, growth * number / (points - 1) + float(noise[number]), 0.002)
    return made.trend()


def under_a_thermostat(growth: float, seed: int, points: int = 37) -> Trend | None:
    """The points err by twice what they say: a twin errs at each speed."""
    made, rng = WearSeries(), np.random.default_rng(seed)
    for number in range(points):
        error = ERRORS[number % len(ERRORS)]
        value = growth * number / (points - 1) + float(rng.normal(0.0, 2.0 * error))
        made.add((1000 + number) * EVERY_NS, value, error)
    return made.trend()


def test_a_fan_that_clogs_is_noticed_with_the_fans_beside_it() -> None:
    (line,) = slow_changes("drag", [trend_of(0.0, 1), trend_of(0.0, 2), trend_of(0.055, 3), trend_of(0.002, 4)])
    assert line.startswith("fan 2: drag +5.")
    assert " % in 3.0 h, +1.9 % an hour, the fans beside it -0.0" in line
    assert line.endswith(": see fantwin wear")


def test_what_happens_to_all_fans_is_the_weather() -> None:
    assert slow_changes("drag", [trend_of(0.05, seed) for seed in range(4)]) == []


def test_points_that_scatter_as_much_are_no_change() -> None:
    wild, rng = WearSeries(), np.random.default_rng(0)
    for number in range(POINTS):
        wild.add((1000 + number) * EVERY_NS, float(rng.normal(0.004 * number, 0.05)), 0.002)
    assert slow_changes("drag", [wild.trend(), trend_of(0.0, 1)]) == []


def test_points_that_are_hardly_determined_hide_no_clogging_and_are_none() -> None:
    healthy = [under_a_thermostat(0.0, seed) for seed in range(104)]
    assert slow_changes("drag", healthy) == []
    (line,) = slow_changes("drag", [under_a_thermostat(0.3, 103), *healthy[:3]])
    assert line.startswith("fan 0: drag +") and " % in 6.0 h, +" in line
    assert slow_changes("drag", [under_a_thermostat(0.2, 102), *healthy[:3]]) == [], "it is beyond one interval only"


def test_a_fan_without_others_or_with_too_few_points_is_judged_by_itself_or_not_at_all() -> None:
    (alone,) = slow_changes("drag", [trend_of(-0.06, 1), trend_of(0.0, 2, points=9), trend_of(0.0, 3, first=50)])
    assert alone.startswith("fan 0: drag -") and "beside" not in alone
