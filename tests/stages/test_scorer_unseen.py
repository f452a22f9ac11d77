"""stages.scorer: where its twin may be wrong the band is wider."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.runtime.healthy_twin import HealthyTwin, ScorerConfig, limits_in_force
from scoring.unseen_error import UnseenError
from stages.scorer import NOT_CALIBRATED, ScorerCore
from tests.support.scored_blocks import CALIBRATION, SIGMA, balance_of_a_fan, feed, prediction_of
from tests.support.uncertainty_tables import by_speed

EVERYWHERE = by_speed((0.0, 600.0), (0.0, 100.0), ((20.0, 20.0), (20.0, 20.0)), 0.0)


@pytest.mark.parametrize("is_calibrated", [True, False])
def test_people_are_told_that_a_twin_is_not_calibrated(is_calibrated: bool) -> None:
    limits = limits_in_force(ScorerConfig(), CALIBRATION if is_calibrated else None)
    twin = HealthyTwin("twin", limits, [balance_of_a_fan()], "%", is_calibrated=is_calibrated)
    assert (NOT_CALIBRATED in ScorerCore(1, "rad/s", ScorerConfig(), twin).notes()) != is_calibrated


@pytest.mark.parametrize("is_wider", [True, False])
def test_the_unseen_error_widens_band_and_limits(is_wider: bool) -> None:
    everywhere = UnseenError(EVERYWHERE, None, np.array([0.05]), np.array([0.0002]), command_width=100.0)
    settings = ScorerConfig()
    limits = limits_in_force(settings, CALIBRATION)
    twin = HealthyTwin("twin", limits, [balance_of_a_fan()], "%", unseen_error=everywhere if is_wider else None)
    core = ScorerCore(1, "rad/s", settings, twin)
    noise = np.random.default_rng(1).normal(0.0, SIGMA, 4000)
    noise[2000:] += 20.0
    scores, alarms = feed(core, [prediction_of(noise)])
    half_rad_s = (scores[0].upper_bound_rad_s - scores[0].lower_bound_rad_s) / 2.0
    np.testing.assert_allclose(half_rad_s, 2.0 * (np.hypot(SIGMA, 20.0) if is_wider else SIGMA))
    assert bool(alarms) != is_wider
