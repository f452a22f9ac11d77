"""scoring.wear.followed: notices of what baselines and the shared offset have taken up."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from scoring.baseline.healthy_residual import HealthyResidual
from scoring.baseline.settings import BaselineSettings
from scoring.detectors.alarm_units import AlarmUnits
from scoring.fan_scorer import FanScorer
from scoring.limits import Limits, Timing
from scoring.wear.followed import followed_fans, shared_by_all
from tests.support.healthy_residuals import in_blocks, samples_of

FANS, LIMIT, SPEED_SIGMAS = 4, 0.03, 100.0
"""the speed of all fans is so many sigma"""


def scorer_after(offset_sigmas: list[float], turning: int = FANS) -> FanScorer:
    """After two minutes without and three with these offsets of the speed residuals, while so many of the fans turn."""
    baseline = BaselineSettings(adaptation_limit_sigmas=4.0)
    residual = HealthyResidual(shared_limit=LIMIT, residual_std=(0.1,), baseline=baseline)
    scorer = FanScorer(FANS, Limits(speed=residual, balance=residual, timing=Timing(adaptation_s=60.0)))
    later = np.arange(3000)[:, np.newaxis] >= 1200
    noise = np.random.default_rng(1).normal(0.0, 0.1, (3000, FANS))
    samples = samples_of(noise + later * np.array(offset_sigmas), noise, period_ns=100_000_000)
    sigma = samples.speed_rad_s / SPEED_SIGMAS
    turns = ~later | (np.arange(FANS) < turning)
    known = {"speed_valid": turns, "balance_valid": turns, "speed_sigma_rad_s": sigma, "balance_sigma": sigma}
    for block in in_blocks(replace(samples, **known)):
        scorer.update(block)
    return scorer


@pytest.mark.parametrize(
    ("share", "note"),
    [(0.029, "2.7 % faster"), (0.02, ""), (-0.5, "3.0 % slower")],
)
def test_what_most_fans_share_is_noted_from_three_quarters_of_its_limit_on(share: float, note: str) -> None:
    shift = share * SPEED_SIGMAS
    residual = scorer_after([shift, shift, shift, 0.0]).residuals["speed"]
    lines = shared_by_all(residual.shared_offset, LIMIT)
    assert len(lines) == bool(note)
    assert all(line.startswith(f"most fans turn {note} than when") and "beyond 3.0 %" in line for line in lines)


def test_nothing_is_shared_without_a_limit_or_by_one_fan() -> None:
    assert shared_by_all(0.0, 0.0) == []
    assert shared_by_all(scorer_after([-2.5, 0.0, 0.0, 0.0]).residuals["speed"].shared_offset, LIMIT) == []


def test_a_fan_that_turns_alone_shares_nothing() -> None:
    """Its own change is followed in place of its baseline."""
    assert shared_by_all(scorer_after([-2.7, 0.0, 0.0, 0.0], turning=1).residuals["speed"].shared_offset, LIMIT) == []


def test_a_fan_that_its_baseline_has_followed_far_is_noted() -> None:
    baseline = scorer_after([-3.0, 0.0, 0.0, 0.0]).residuals["speed"].baseline
    (line,) = followed_fans(baseline, 3.0, np.full(FANS, 1.0), AlarmUnits("rad/s"))
    assert line.startswith("fan 0: the baseline of its speed has followed it by -90 % of")
