"""What the residuals of all fans have in common at a speed, from how long each was there."""

from __future__ import annotations

import numpy as np
import pytest

from scoring.calibration.healthy_variation import _mean_over_fans
from scoring.calibration.residual_moments import SPEED_BINS, ResidualMoments

PERIOD_S = 0.5


def mean_at_first_speed(seconds: list[float], residuals: list[float], elsewhere_s: float = 600.0) -> float:
    """Of fans that were so long at the first speed, with these residuals, and elsewhere at the second."""
    moments = ResidualMoments()
    for fan, (there_s, residual) in enumerate(zip(seconds, residuals, strict=True)):
        cells = np.zeros((2, SPEED_BINS))
        cells[:, 0] = there_s / PERIOD_S * np.array((1.0, residual))
        cells[0, 1] = elsewhere_s / PERIOD_S
        moments.of_fans["tray", fan] = cells
    return _mean_over_fans(moments, [0], PERIOD_S)


@pytest.mark.parametrize(
    ("seconds", "residuals", "expected"),
    [
        ([300.0] * 4, [-6.0] * 4, -6.0),
        ([600.0, 0.0, 0.0, 0.0], [-6.0, 0.0, 0.0, 0.0], -1.5),
        ([600.0, 1.0, 1.0, 1.0], [-6.0, 0.0, 0.0, 0.0], -1.5),  # the others only passed it
        ([9000.0, 60.0], [-6.0, 0.0], -3.0),  # half a minute says enough of a fan
        ([600.0], [-6.0], -6.0),
        ([2.0] * 200, [-6.0] * 200, -6.0),  # none was there for long, and all alike
    ],
)
def test_a_fan_that_was_not_there_counts_as_zero(seconds: list[float], residuals: list[float], expected: float) -> None:
    assert mean_at_first_speed(seconds, residuals) == pytest.approx(expected)


def test_a_fan_that_was_never_scored_does_not_count() -> None:
    moments = ResidualMoments()
    of_fan = np.zeros((2, SPEED_BINS))
    of_fan[:, 0] = 600.0, -3600.0
    moments.of_fans = {("", 0): of_fan, ("", 1): of_fan, ("", 2): np.zeros((2, SPEED_BINS))}
    assert _mean_over_fans(moments, [0], PERIOD_S) == pytest.approx(-6.0)


def test_nobody_was_there() -> None:
    assert mean_at_first_speed([0.0, 0.0], [0.0, 0.0]) == 0.0
