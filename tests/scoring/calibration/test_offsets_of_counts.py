"""What calibration expects of fans whose tachos count: readings are steps, and say little about the speed."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from schemas.messages import Array
from schemas.tacho import Tacho
from scoring.baseline.healthy_residual import FanOffsets, HealthyResidual
from scoring.calibration.healthy_statistics import HealthyRun
from scoring.fan_scorer import FanScorer
from scoring.limits import Limits, default_timing
from scoring.samples import Samples
from tests.support.calibrated_runs import calibrate
from tests.support.healthy_residuals import autoregressive, in_blocks, rows_of, samples_of

FANS, RUNS, PERIOD_NS = 3, 12, 100_000_000
SIGMA_RAD_S = 2.0
COUNTS = Tacho(kind="count", pulses=2, window_s=0.5)
STEP_RAD_S = COUNTS.resolution_rad_s
SLOW_RAD_S = 5.0 * STEP_RAD_S
"""all readings of it are the same"""


def counted(seed: int, seconds: float, slow_s: float) -> Samples:
    """Fans without any error of their twin, most of the time at a speed between two steps, then at one of them."""
    rows = round(10 * seconds)
    slow = np.arange(rows)[:, np.newaxis] >= rows - 10 * slow_s
    turning: Array = np.where(slow, SLOW_RAD_S, SLOW_RAD_S + 0.6 * STEP_RAD_S) * np.ones(FANS)
    phase = np.random.default_rng(seed).random((rows, FANS))
    reading = STEP_RAD_S * np.floor(turning / STEP_RAD_S + phase * (1.0 - 1e-9) + 1e-9)
    noise, balance = (autoregressive(rows, FANS, 0.0, 2 * seed + number) for number in (0, 1))
    made = samples_of((reading - turning) / SIGMA_RAD_S + 0.1 * noise, balance, period_ns=PERIOD_NS)
    sigma = np.full(turning.shape, SIGMA_RAD_S)
    return replace(made, speed_rad_s=reading, predicted_rad_s=turning, speed_sigma_rad_s=sigma, balance_sigma=sigma)


def healthy() -> Iterator[HealthyRun]:
    for run in range(RUNS):
        blocks = in_blocks(counted(run, 200.0, 4.0))
        yield HealthyRun(f"run {run}", FANS, blocks, range(FANS), tachos=(COUNTS,))


def expected_when_slow(limits: Limits) -> Array:
    """(fans,) the mean residual that limits allow for at the step, sigma."""
    offsets = limits.speed.fan_offsets
    assert offsets
    return np.array([np.interp(SLOW_RAD_S, offsets.speeds_rad_s, of_fan) for of_fan in offsets.offset_sigmas])


def test_a_speed_at_a_step_is_expected_to_read_as_it_does() -> None:
    limits = calibrate(healthy, 200.0, default_timing(FANS), 40.0, has_drive=True, over_predicted_speed=True)
    np.testing.assert_allclose(expected_when_slow(limits), 0.0, atol=0.05)


def test_scores_take_the_offset_at_the_predicted_speed() -> None:
    seen = rows_of(counted(1, 10.0, 0.0), slice(0, 100))
    speeds_rad_s = (SLOW_RAD_S, SLOW_RAD_S + 0.6 * STEP_RAD_S, SLOW_RAD_S + STEP_RAD_S)
    offsets = FanOffsets(speeds_rad_s=speeds_rad_s, offset_sigmas=((7.0, 1.0, 7.0),) * FANS)
    of = HealthyResidual(fan_offsets=offsets)
    for over_predicted_speed, expected in ((True, 1.0), (False, 7.0)):
        limits = Limits(speed=of, balance=of, over_predicted_speed=over_predicted_speed)
        scorer = FanScorer(FANS, limits, for_calibration=True)
        scorer.update(seen)
        (found,) = scorer.observed()
        np.testing.assert_allclose(found.expected["speed"], expected, rtol=1e-9)
