"""scoring.calibration.fan_spread: fans whose residuals vary more have wider limits, and chance alone changes none."""

import numpy as np
import pytest

from schemas.messages import Array
from scoring.calibration.fan_spread import FanSquares, fan_spread

HOUR_S = 3600.0


def run_of(hours: float, residual: Array, persistent: Array) -> FanSquares:
    seconds = np.full(len(residual), hours * HOUR_S)
    return FanSquares(range(len(residual)), seconds, seconds * residual**2, seconds * persistent**2)


def test_after_hours_each_fan_has_nearly_its_own_spread_and_after_minutes_nearly_the_common_one() -> None:
    residual, persistent = np.array([2.0, 2.0, 1.0, 1.0]), np.array([3.0, 3.0, 1.0, 1.0])
    found = fan_spread([run_of(5.0, residual, persistent), run_of(5.0, residual, persistent)])
    assert found is not None
    assert found.residual[0] / found.residual[2] == pytest.approx(2.0, rel=0.02)
    assert found.residual[0] * found.persistent[0] / (found.residual[2] * found.persistent[2]) == pytest.approx(
        3.0, rel=0.02
    )
    assert np.prod(found.residual) == pytest.approx(1.0, rel=1e-3), "the limits of all together stay"
    short = fan_spread([run_of(0.1, residual, persistent)])
    assert short is not None
    assert 1.0 < short.residual[0] / short.residual[2] < 1.7


def test_fans_that_differ_by_chance_keep_the_common_limits() -> None:
    rng = np.random.default_rng(1)
    minutes = 600
    levels = np.sqrt(rng.chisquare(minutes, size=20) / minutes)
    found = fan_spread([run_of(minutes / 60.0, levels, levels)])
    assert found is not None
    assert np.ptp(found.residual) < 0.3 * np.ptp(levels)


def test_a_fan_that_was_not_seen_has_the_common_limits() -> None:
    seconds = np.array([HOUR_S, HOUR_S, 0.0])
    squares = seconds * np.array([4.0, 1.0, 0.0])
    found = fan_spread([FanSquares(range(3), seconds, squares, squares)])
    assert found is not None and found.residual[2] == found.persistent[2] == 1.0
    assert fan_spread([]) is None
