"""scoring.wear.reference: it expects of a healthy fan what the scorer of the same twin expects."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from scoring.baseline.healthy_residual import FanOffsets, HealthyResidual
from scoring.baseline.settings import BaselineSettings
from scoring.diagnosis.regression_window import Window
from scoring.limits import Limits
from scoring.residual import Residual
from scoring.wear.reference import HealthyFan, WearReference, healthy_fans
from tests.support.scored_blocks import CALIBRATION, SIGMA_COMMAND, balance_of_a_fan

FANS = 3
RESIDUAL = HealthyResidual(
    speeds_rad_s=(50.0, 150.0, 300.0),
    expected_residual_sigmas=(0.3, -0.1, 0.4),
    residual_std=(1.0, 1.0, 1.0),
    fan_offsets=FanOffsets(speeds_rad_s=(100.0, 250.0), offset_sigmas=((0.1, -0.2), (0.0, 0.3), (-0.1, 0.0))),
    baseline=BaselineSettings(speed_exponent=2, reference_speed_rad_s=200.0, crossover_speed_rad_s=80.0),
)
SPEED_RAD_S = np.array([0.0, 40.0, 99.0, 180.0, -260.0, 340.0])
OFFSET_COMMAND = 0.25


def reference_of(fan: int, residual: HealthyResidual = RESIDUAL) -> WearReference:
    return WearReference(healthy_fans([balance_of_a_fan()] * FANS, residual)[fan], OFFSET_COMMAND)


def window_at(speed_rad_s: Any) -> Window:
    return Window(period_s=0.01, command=np.zeros(len(speed_rad_s)), speed_rad_s=speed_rad_s, onset=0)


@pytest.mark.parametrize("fan_offsets", [RESIDUAL.fan_offsets, None])
@pytest.mark.parametrize("fan", range(FANS))
def test_it_expects_the_balance_that_the_scorer_expects(fan: int, fan_offsets: FanOffsets | None) -> None:
    residual = RESIDUAL.model_copy(update={"fan_offsets": fan_offsets})
    limits = Limits.model_validate(CALIBRATION).model_copy(update={"balance": residual})
    by_fan = np.tile(SPEED_RAD_S[:, np.newaxis], (1, FANS))
    nothing = np.zeros(by_fan.shape)
    scored = Residual(FANS, "balance", limits, shares_at_first=True, compares_fast=True).samples(
        nothing, nothing + SIGMA_COMMAND, nothing == 0.0, nothing, by_fan, nothing, 0.01
    )
    applied = reference_of(fan, residual).applied_to(window_at(SPEED_RAD_S))
    np.testing.assert_allclose(applied.expected_command, scored.expected[:, fan] * SIGMA_COMMAND, atol=1e-12)
    last = OFFSET_COMMAND * scored.scaling[-1, fan]
    assert applied.fan_offset == pytest.approx(last)


def test_an_unknown_speed_has_no_expected_balance() -> None:
    applied = reference_of(0).applied_to(window_at(np.array([np.nan, 180.0])))
    assert np.isfinite(applied.expected_command).tolist() == [False, True]


def test_a_snapshot_of_it_is_json_and_loses_nothing() -> None:
    reference = replace(reference_of(1), of_earlier_twin=True)
    stored = json.loads(json.dumps(reference.snapshot(), allow_nan=False))
    assert WearReference.restore(stored).snapshot() == reference.snapshot()


@pytest.mark.parametrize(
    "broken",
    [{"speeds_rad_s": [1.0]}, {"expected_command": "x"}, {"offset_scaling": {}}, {"balance": {"inertia": 1.0}}],
)
def test_an_invalid_snapshot_is_refused(broken: dict[str, Any]) -> None:
    stored = reference_of(0).healthy.snapshot() | broken
    with pytest.raises((ValueError, LookupError, TypeError)):
        HealthyFan.restore(stored)
