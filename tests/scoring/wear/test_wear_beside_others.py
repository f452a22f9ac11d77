"""scoring.wear.wear_monitor, through the scorer: what all fans of a tray have in common is no wear of one of them."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest

from stages.scorer import ScorerCore
from tests.support.scored_blocks import (
    CALIBRATION,
    SIGMA_COMMAND,
    TWIN_SPEED,
    commissioned,
    core_of,
    prediction_of,
    snapshot_of,
)

FANS = 3
PERIOD_NS, PER_S = 200_000_000, 5
SECONDS, RAMP_S = 200, (10, 130)
CHANGE_SIGMAS = 0.8
BESIDE_OTHERS: Mapping[str, Any] = CALIBRATION | {
    "balance": {
        "shared_limit": 3.0 * CHANGE_SIGMAS * SIGMA_COMMAND / TWIN_SPEED,
        "residual_std": [0.4],
        "baseline": {"commissioning_limit_sigmas": 3.0, "adaptation_limit_sigmas": 2.0},
    },
    "detectors": CALIBRATION["detectors"] | {"balance_drift": {"limit": 60.0, "period_s": 0.2}},  # the ramp is no fault
}


def scorer_after(changed: list[int]) -> ScorerCore:
    """After some minutes, in which these fans come to take more of the command, slowly enough for their baselines."""
    core = commissioned(core_of(FANS, calibration=BESIDE_OTHERS, wear_every_s=10.0), FANS)
    rng = np.random.default_rng(5)
    shape = (SECONDS * PER_S, FANS)
    more = np.interp(np.arange(shape[0]) / PER_S, RAMP_S, (0.0, 1.0))[:, np.newaxis] * np.isin(np.arange(FANS), changed)
    balance = CHANGE_SIGMAS * SIGMA_COMMAND * more + rng.normal(0.0, 0.05, shape)
    core.step(prediction_of(rng.normal(0.0, 0.3, shape), balance=balance, period_ns=PERIOD_NS))
    return core


def wear_sigmas(core: ScorerCore) -> list[float]:
    """The last change of each fan's balance since its commissioning."""
    fans = json.loads(snapshot_of(core).state_json)["wear"]["fans"]
    return [fan["parameters"]["balance"]["series"]["value"][-1] / SIGMA_COMMAND for fan in fans]


def test_a_change_of_all_fans_is_no_wear_of_one_and_the_same_change_of_one_fan_is() -> None:
    in_common, of_one = wear_sigmas(scorer_after([0, 1, 2])), wear_sigmas(scorer_after([1]))
    assert in_common == pytest.approx([0.0] * FANS, abs=0.1 * CHANGE_SIGMAS)
    assert of_one == pytest.approx([0.0, CHANGE_SIGMAS, 0.0], abs=0.2 * CHANGE_SIGMAS)
