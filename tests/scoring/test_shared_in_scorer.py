"""What the fans of a tray share, within the scorer: cuts and restarts change no bit of it."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from schemas.messages import Array
from scoring.baseline.healthy_residual import HealthyResidual
from scoring.baseline.settings import BaselineSettings
from scoring.detectors.drift import DriftSettings
from scoring.detectors.smoothed import SmoothedSettings
from scoring.fan_scorer import FanScorer
from scoring.limits import Limits, default_timing
from scoring.samples import Samples
from tests.support.healthy_residuals import autoregressive, rows_of, samples_of

FANS = 3
PERIOD_NS, PER_S = 100_000_000, 10
SAMPLES = 60 * PER_S
SIGMA_RAD_S, SIGMA_COMMAND, SPEED_RAD_S = 2.0, 0.5, 100.0
WEATHER = -0.02  # of the speed, and of the command, which is half of it
ALONE = slice(35 * PER_S, 45 * PER_S)  # without the second fan and the third


def limits() -> Limits:
    """Of a tray, with twice as much shared as the weather here."""
    baseline = BaselineSettings(commissioning_limit_sigmas=3.0, adaptation_limit_sigmas=1.0)
    speed = HealthyResidual(shared_limit=0.04, residual_std=(0.2,), baseline=baseline)
    return Limits(
        speed=speed,
        balance=speed.model_copy(update={"shared_limit": 0.02}),
        detectors={
            f"{source}_{kind}": settings
            for source in ("speed", "balance")
            for kind, settings in (
                ("smoothed", SmoothedSettings(limit=6.0)),
                ("drift", DriftSettings(limit=50.0, reference_sigmas=5.0, period_s=0.1)),
            )
        },
        timing=default_timing(FANS),
    )


def tray() -> Samples:
    """A minute. The weather comes at 12 s; a fan turns alone for 10 s; another one is faulty at the end."""
    rows = np.arange(SAMPLES)
    weather = WEATHER * (rows >= 12 * PER_S)[:, np.newaxis] * SPEED_RAD_S * np.ones(FANS)
    fault = np.zeros((SAMPLES, FANS))
    fault[50 * PER_S :, 2] = -3.0
    speed, balance = (0.2 * autoregressive(SAMPLES, FANS, 0.0, seed) + fault for seed in (1, 2))
    speed += weather / SIGMA_RAD_S
    balance += 0.5 * weather / SIGMA_COMMAND
    for residual in (speed, balance):
        residual[ALONE, 1:] = np.nan
        residual[::37, 0] = np.nan  # some readings are missing
    made = samples_of(speed, balance, period_ns=PERIOD_NS)
    sigma = np.ones(speed.shape)
    return replace(made, speed_sigma_rad_s=SIGMA_RAD_S * sigma, balance_sigma=SIGMA_COMMAND * sigma)


def scored_of(scorer: FanScorer, samples: Samples, edges: Sequence[int]) -> dict[str, Array]:
    """The scores, of blocks between these rows."""
    parts = [scorer.update(rows_of(samples, slice(*edge))) for edge in pairwise(edges)]
    return {name: np.concatenate([getattr(part, name) for part in parts]) for name in vars(parts[0])}


@pytest.fixture(scope="module")
def whole() -> tuple[FanScorer, dict[str, Array]]:
    scorer = FanScorer(FANS, limits())
    return scorer, scored_of(scorer, tray(), [0, SAMPLES])


def test_the_weather_is_subtracted_and_a_fault_is_not(whole: tuple[FanScorer, dict[str, Array]]) -> None:
    _, scored = whole
    for source, sigmas in (("speed", WEATHER * SPEED_RAD_S / SIGMA_RAD_S), ("balance", WEATHER * 50.0 / SIGMA_COMMAND)):
        smoothed, baseline = scored[f"{source}_smoothed"], scored[f"{source}_baseline"]
        late = slice(48 * PER_S, 50 * PER_S)
        np.testing.assert_allclose(baseline[late].mean(axis=0), sigmas, rtol=0.25)
        np.testing.assert_allclose(np.nanmean(smoothed[late], axis=0), 0.0, atol=0.25 * abs(sigmas))
        assert smoothed[-PER_S:, 2].mean() < -2.0
        assert np.all(np.abs(np.nanmean(smoothed[-PER_S:, :2], axis=0)) < 0.5)
    np.testing.assert_allclose(scored["balance_shared"][49 * PER_S], scored["balance_baseline"][49 * PER_S], atol=0.2)


@pytest.mark.parametrize("step", [1, 333])
def test_cuts_change_no_bit(step: int, whole: tuple[FanScorer, dict[str, Array]]) -> None:
    of_whole, scored = whole
    scorer = FanScorer(FANS, limits())
    cut = scored_of(scorer, tray(), [*range(0, SAMPLES, step), SAMPLES])
    for name, values in scored.items():
        np.testing.assert_array_equal(cut[name], values, err_msg=name)
    assert json.dumps(scorer.snapshot()) == json.dumps(of_whole.snapshot())


@pytest.mark.parametrize("row", [20 * PER_S + 3, 40 * PER_S])
def test_a_restored_scorer_continues_with_the_same_bits(row: int, whole: tuple[FanScorer, dict[str, Array]]) -> None:
    of_whole, scored = whole
    first, second, samples = FanScorer(FANS, limits()), FanScorer(FANS, limits()), tray()
    first.update(rows_of(samples, slice(0, row)))
    state = json.loads(json.dumps(first.snapshot(), allow_nan=False))
    assert state["speed"]["shared"]["value"][0] < -0.001
    second.restore(state)
    after = scored_of(second, samples, [row, SAMPLES])
    for name, values in scored.items():
        np.testing.assert_array_equal(after[name], values[row:], err_msg=name)
    assert second.snapshot() == of_whole.snapshot()


def test_fans_that_all_became_slower_and_are_commissioned_again_are_healthy_at_all_speeds() -> None:
    scorer = FanScorer(FANS, limits())
    speed_rad_s = np.repeat(np.tile([50.0, 200.0], 5), 12 * PER_S)[:, np.newaxis] * np.ones(FANS)  # for 12 s each
    residual = 0.2 * autoregressive(len(speed_rad_s), FANS, 0.0, 1)
    residual[24 * PER_S :] += WEATHER * speed_rad_s[24 * PER_S :] / SIGMA_RAD_S
    made = samples_of(residual, np.zeros(residual.shape), period_ns=PERIOD_NS)
    made = replace(made, speed_rad_s=speed_rad_s, predicted_rad_s=speed_rad_s)
    made = replace(made, speed_sigma_rad_s=np.full(residual.shape, SIGMA_RAD_S))
    scorer.update(rows_of(made, slice(0, 73 * PER_S)))
    scorer.recommission(np.ones(FANS, np.bool_))  # at the low speed, where it is half a sigma
    scored = scorer.update(rows_of(made, slice(73 * PER_S, len(speed_rad_s))))
    at_high_speed = slice(13 * PER_S, 23 * PER_S)
    off = np.abs(scored.speed_smoothed[at_high_speed].mean(axis=0))
    assert (off < 0.1).all()
