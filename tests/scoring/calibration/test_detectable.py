"""scoring.calibration.detectable: a drop that is said to be found is found in that time, and a smaller one is not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from schemas.messages import Array
from scoring.baseline.healthy_residual import HealthyResidual
from scoring.baseline.settings import BaselineSettings
from scoring.calibration.calibration import FragmentedError
from scoring.calibration.detectable import detectable_drops
from scoring.calibration.healthy_statistics import HealthyRun
from scoring.detectors.drift import DriftSettings
from scoring.detectors.smoothed import SmoothedSettings
from scoring.limits import Limits, Timing
from tests.support.calibrated_runs import calibrate
from tests.support.healthy_residuals import alarms_of, autoregressive, samples_of
from tests.support.scored_blocks import balance_of_a_fan

SPEED, SIGMA, PERIOD_S = 100.0, 3.0, 0.1
RESIDUAL = HealthyResidual(
    speeds_rad_s=(SPEED, 300.0),
    expected_residual_sigmas=(0.0, 0.0),
    residual_std=(1.0, 1.5),
    persistent_std=(1.2, 1.0),
    baseline=BaselineSettings(adaptation_limit_sigmas=2.0),
)
LIMITS = Limits(
    speed=RESIDUAL,
    balance=HealthyResidual(),
    detectors={
        "speed_smoothed": SmoothedSettings(limit=6.0),
        "speed_drift": DriftSettings(limit=40.0, reference_sigmas=0.4, period_s=PERIOD_S),
    },
)


def found_after_s(drop_rad_s: float) -> float:
    """How long after the drop the alarm comes; infinite for none within a minute."""
    healthy, after = 60.0, 60.0
    at_s = np.arange(round((healthy + after) / PERIOD_S)) * PERIOD_S
    speed: Array = 0.02 * autoregressive(len(at_s), 1, 0.0, 1)
    speed -= np.where(at_s >= healthy, drop_rad_s / SIGMA, 0.0)[:, np.newaxis]
    samples = samples_of(speed, np.full(speed.shape, np.nan), period_ns=round(PERIOD_S * 1e9))
    raised = alarms_of(LIMITS, [samples], 1)
    return min((alarm.t_s - healthy for alarm in raised), default=np.inf)


def test_a_drop_that_is_said_to_be_found_is_found_in_that_time_and_a_smaller_one_is_not() -> None:
    (drop,) = detectable_drops(LIMITS, SIGMA, balance_of_a_fan(), [SPEED])
    assert found_after_s(1.05 * drop.at_once_rad_s) < 2.0 < found_after_s(0.9 * drop.at_once_rad_s)
    assert 2.0 < found_after_s(1.07 * drop.within_a_minute_rad_s) <= 60.0
    assert found_after_s(0.93 * drop.within_a_minute_rad_s) == np.inf


def test_it_is_of_a_fan_whose_offset_is_known_at_the_mean_speed_of_calibration() -> None:
    """An offset that follows the speed is not known above that speed."""
    follows = {"speed_exponent": 1, "reference_speed_rad_s": SPEED, "rms_sigmas": 2.0}
    baseline = RESIDUAL.baseline.model_copy(update=follows)
    limits = LIMITS.model_copy(update={"speed": RESIDUAL.model_copy(update={"baseline": baseline})})
    at_mean, above = detectable_drops(limits, SIGMA, balance_of_a_fan(), [SPEED, 2.0 * SPEED])
    known_at_mean, known_above = detectable_drops(LIMITS, SIGMA, balance_of_a_fan(), [SPEED, 2.0 * SPEED])
    assert at_mean.at_once_rad_s == known_at_mean.at_once_rad_s
    assert above.at_once_rad_s > 1.5 * known_above.at_once_rad_s


def test_what_no_limit_watches_is_not_found() -> None:
    (drop,) = detectable_drops(LIMITS.model_copy(update={"detectors": {}}), SIGMA, balance_of_a_fan(), [SPEED])
    assert drop.at_once_rad_s == drop.within_a_minute_rad_s == np.inf


def test_runs_that_lack_samples_in_every_second_are_refused() -> None:
    """Limits were not numbers then."""
    speed, balance = (autoregressive(6000, 2, 0.0, seed, PERIOD_S) for seed in (1, 2))
    made = samples_of(speed, balance, period_ns=100_000_000)
    scored = np.broadcast_to((np.arange(6000) % 2 == 0)[:, np.newaxis], (6000, 2))
    run = HealthyRun("night", 2, [replace(made, speed_valid=scored, balance_valid=scored)])
    with pytest.raises(FragmentedError):
        calibrate(lambda: [run], 300.0, Timing(), 1.0, extrapolate=True)
