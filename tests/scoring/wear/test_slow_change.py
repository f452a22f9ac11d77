"""scoring.wear.slow_change: a fan that changes against the fans beside it is noticed, and weather is not."""

from __future__ import annotations

import numpy as np

from scoring.wear.slow_change import slow_changes
from scoring.wear.trend import WearSeries

EVERY_NS = 600 * 10**9
POINTS = 19
"""three hours"""


def series_of(growth: float, seed: int, points: int = POINTS, first: int = 0) -> WearSeries:
    made = WearSeries()
    noise = np.random.default_rng(seed).normal(0.0, 0.003, points)
    for number in range(points):
        made.add((1000 + first + number) * EVERY_NS, growth * number / (points - 1) + float(noise[number]), 0.002)
    return made


def test_a_fan_that_clogs_is_noticed_with_the_fans_beside_it() -> None:
    (line,) = slow_changes("drag", [series_of(0.0, 1), series_of(0.0, 2), series_of(0.055, 3), series_of(0.002, 4)])
    assert line.startswith("fan 2: drag +5.") and "% over 3 h, the fans beside it -0.0 %" in line
    assert line.endswith(" %: see fantwin wear")


def test_what_happens_to_all_fans_is_the_weather() -> None:
    assert slow_changes("drag", [series_of(0.05, seed) for seed in range(4)]) == []


def test_points_that_scatter_as_much_are_no_change() -> None:
    wild = WearSeries()
    for number in range(POINTS):
        wild.add((1000 + number) * EVERY_NS, 0.1 * (number % 2) + 0.004 * number, 0.002)
    assert slow_changes("drag", [wild, series_of(0.0, 1)]) == []


def test_a_fan_without_others_or_with_too_few_points_is_judged_by_itself_or_not_at_all() -> None:
    (alone,) = slow_changes("drag", [series_of(-0.06, 1), series_of(0.0, 2, points=3), series_of(0.0, 3, first=50)])
    assert alone.startswith("fan 0: drag -") and "beside" not in alone
