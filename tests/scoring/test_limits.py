"""scoring.limits: the deviations of statistics that limits are multiples of, and what a card may hold."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from pydantic import ValidationError

from scoring.detectors.low_pass import LowPass
from scoring.limits import (
    DeclaredRate,
    Limits,
    ResidualLimits,
    Timing,
    smoothed_deviation,
    summed_deviation,
    uncalibrated,
)
from tests.support.healthy_residuals import autoregressive

STEP_S = 0.01


@pytest.mark.parametrize("memory_s", [0.0, 0.05, 0.5])
def test_the_deviation_of_a_smoothed_residual_is_what_it_is_on_simulated_ones(memory_s: float) -> None:
    residual = autoregressive(20_000, 50, memory_s, 1)
    smoothed = LowPass(50, 0.2).update(residual, np.ones(residual.shape, np.bool_), STEP_S)[500:]
    assert smoothed.std() == pytest.approx(smoothed_deviation(0.2, memory_s, STEP_S), rel=0.03)


@pytest.mark.parametrize("memory_s", [0.0, 0.05, 0.5])
def test_the_deviation_of_a_long_sum_is_what_it_is_on_simulated_ones(memory_s: float) -> None:
    sums = autoregressive(10_000, 400, memory_s, 2).sum(axis=0) * STEP_S
    assert sums.std() == pytest.approx(summed_deviation(memory_s, STEP_S) * math.sqrt(100.0), rel=0.1)


@pytest.mark.parametrize("step_s", [0.002, 0.01, 0.1])
def test_without_a_calibration_the_limit_is_in_sigma_of_the_speed_whatever_the_rate(step_s: float) -> None:
    limits = uncalibrated(2.0, Timing())
    memory_s = limits.speed.autocorrelation_time_s
    assert limits.speed.step == 2.0
    assert smoothed_deviation(limits.timing.smoothing_s, memory_s, step_s) == pytest.approx(1.0, rel=1e-6)
    assert limits.speed.drift is limits.speed.growth is limits.balance.step is None


def calibrated() -> Limits:
    speed = ResidualLimits(
        speeds_rad_s=(50.0, 100.0),
        offset_sigmas=(0.1, 0.2),
        spread=(0.9, 1.1),
        step=4.0,
        drift=10.0,
        growth=1.4,
        usual_growth=1.0,
    )
    promise = DeclaredRate(
        false_alarms_per_day=1.0, interval_95=(0.5, 2.0), extrapolated=False, fan_hours=100.0, runs=3
    )
    return Limits(speed=speed, balance=ResidualLimits(), promise=promise)


def test_limits_go_through_a_card_and_come_back() -> None:
    limits = calibrated()
    assert Limits.model_validate(json.loads(limits.model_dump_json())) == limits


def test_a_factor_moves_every_limit_and_what_was_promised_is_no_longer() -> None:
    limits = calibrated().times(2.0)
    assert (limits.speed.step, limits.speed.drift) == (8.0, 20.0)
    assert limits.speed.growth == pytest.approx(1.8)  # twice as far from what it usually is
    assert limits.balance.step is None
    assert limits.promise is None
    assert calibrated().times(1.0) == calibrated()


@pytest.mark.parametrize(
    "wrong",
    [
        {"speeds_rad_s": (100.0, 50.0), "offset_sigmas": (0.0, 0.0), "spread": (1.0, 1.0)},
        {"speeds_rad_s": (50.0, 100.0)},
        {"spread": (0.0,)},
        {"step": 0.0},
        {"drift": math.inf},
        {"growth": 1.0, "usual_growth": 1.0},
        {"steps": 3.0},
    ],
)
def test_limits_that_make_no_sense_are_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(ValidationError):
        ResidualLimits.model_validate(wrong)
