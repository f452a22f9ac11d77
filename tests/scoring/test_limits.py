"""scoring.limits: the deviations of statistics that limits are multiples of, and what a card may hold."""

from __future__ import annotations

import json
import math

import pytest
from pydantic import ValidationError

from scoring.baseline.healthy_residual import HealthyResidual
from scoring.detectors.deviation import smoothed_deviation
from scoring.detectors.drift import DriftSettings
from scoring.detectors.smoothed import SmoothedSettings
from scoring.detectors.tacho import TachoSettings
from scoring.detectors.variance_growth import VarianceGrowthSettings
from scoring.limits import DeclaredRate, Limits, Timing, uncalibrated


@pytest.mark.parametrize("period_s", [0.002, 0.1])
def test_without_a_calibration_the_limit_is_in_sigma_of_the_speed_at_every_rate(period_s: float) -> None:
    limits = uncalibrated(2.0, Timing())
    memory_s = limits.speed.autocorrelation_time_s
    assert smoothed_deviation(limits.timing.smoothing_s, memory_s, period_s) == pytest.approx(1.0, rel=1e-6)
    assert limits.detectors.keys() == {"speed_smoothed", "sensor", "missing_readings"}
    assert limits.detectors["speed_smoothed"] == SmoothedSettings(limit=2.0)


def calibrated() -> Limits:
    speed = HealthyResidual(
        speeds_rad_s=(50.0, 100.0),
        expected_residual_sigmas=(0.1, 0.2),
        residual_std=(0.9, 1.1),
        transient_scale_rad_s=3.0,
    )
    rate = DeclaredRate(false_alarms_per_day=1.0, interval_95=(0.5, 2.0), extrapolated=False, fan_hours=100.0, runs=3)
    detectors = {
        "speed_smoothed": SmoothedSettings(limit=4.0),
        "speed_drift": DriftSettings(limit=10.0, period_s=0.02),
        "speed_variance_growth": VarianceGrowthSettings(limit=1.4, healthy=1.0),
        "sensor": TachoSettings(stuck_s=3.0),
    }
    return Limits(speed=speed, balance=HealthyResidual(), detectors=detectors, declared_rate=rate)


def test_limits_survive_the_way_through_a_card() -> None:
    limits = calibrated()
    assert Limits.model_validate(json.loads(limits.model_dump_json())) == limits


def test_a_factor_scales_every_limit_and_voids_the_declared_rate() -> None:
    limits = calibrated().times(2.0)
    assert limits.settings_of("speed", SmoothedSettings) == SmoothedSettings(limit=8.0)
    assert limits.settings_of("speed", DriftSettings) == DriftSettings(limit=20.0, period_s=0.02)
    growth = limits.settings_of("speed", VarianceGrowthSettings)
    assert growth
    assert growth.limit == pytest.approx(1.8)  # twice as far from its healthy value
    assert limits.settings_of("tacho", TachoSettings) == TachoSettings(stuck_s=6.0)
    assert limits.settings_of("balance", SmoothedSettings) is None
    assert limits.speed.baseline.adaptation_limit_sigmas == 2.0
    assert limits.declared_rate is None
    assert calibrated().times(1.0) == calibrated()


@pytest.mark.parametrize(
    ("wrong", "where"),
    [
        ({"speed": {"speeds_rad_s": (100.0, 50.0), "expected_residual_sigmas": (0.0, 0.0)}}, "speed"),
        ({"speed": {"speeds_rad_s": (50.0, 100.0)}}, "one length"),
        ({"speed": {"residual_std": (0.0,)}}, "above zero"),
        ({"detectors": {"speed_smoothed": {"limit": 0.0}}}, "speed_smoothed.limit"),
        ({"detectors": {"speed_drift": {"limit": math.inf, "period_s": 0.01}}}, "speed_drift.limit"),
        ({"detectors": {"speed_variance_growth": {"limit": 1.0, "healthy": 1.0}}}, "above healthy"),
        ({"detectors": {"speed_smoothed": {"limits": 3.0}}}, "speed_smoothed.limit"),
        ({"detectors": {"speed_jitter": {"limit": 3.0}}}, "speed_jitter: there is no such detector"),
    ],
)
def test_wrong_limits_are_refused_by_name(wrong: dict[str, object], where: str) -> None:
    card = {"speed": {}, "balance": {}, "detectors": {}} | wrong
    with pytest.raises(ValidationError, match=where):
        Limits.model_validate(card)
