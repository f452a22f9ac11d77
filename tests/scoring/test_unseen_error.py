"""Where a twin was not trained, its own error widens limits and is not learned as an offset of the fan."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from schemas.messages import Array
from schemas.twin_card import DriveCard
from scoring.fan_scorer import FanScorer
from scoring.limits import Limits
from scoring.samples import Samples
from scoring.unseen_error import RANGE_STDS, UnseenError
from tests.support.healthy_residuals import samples_of as healthy_samples
from tests.support.scored_blocks import CALIBRATION, NEEDED, TWIN_SPEED, prediction_of
from tests.support.uncertainty_tables import by_speed

SECOND = 100
UNSEEN_SIGMAS = 5.0
TABLE = by_speed((0.0, 600.0), (0.0, 100.0), ((0.0, 0.0), (0.0, 20.0)), 0.0)
"""more at high speeds under high commands"""


def of_twin(drive: DriveCard | None = None) -> UnseenError:
    return UnseenError(TABLE, drive, viscous=np.array([0.05]), drag=np.array([0.0002]), command_width=100.0)


def residual(shift: float, seconds: int, seed: int, unseen: float) -> Samples:
    noise = np.random.default_rng(seed).normal(size=(2, seconds * SECOND, 1))
    samples = healthy_samples(noise[0] + shift, noise[1] + shift, first=seed * 1000 * SECOND)
    everywhere = np.full(noise[0].shape, unseen)
    return replace(samples, speed_unseen=everywhere, balance_unseen=everywhere)


def scored(scorer: FanScorer, samples: Samples) -> Array:
    return scorer.update(samples).score


@pytest.fixture
def scorer() -> FanScorer:
    scorer = FanScorer(1, Limits.model_validate(CALIBRATION))
    scored(scorer, residual(0.0, 30, 1, 0.0))
    return scorer


def test_three_standard_deviations_of_it_exceed_no_limit_and_much_more_does(scorer: FanScorer) -> None:
    shift = 3.0 * UNSEEN_SIGMAS
    assert np.nanmax(scored(scorer, residual(shift, 20, 2, UNSEEN_SIGMAS))) < 1.0
    assert np.nanmax(scored(scorer, residual(100.0 * shift, 20, 3, UNSEEN_SIGMAS))) > 1.0
    assert np.nanmax(scored(scorer, residual(shift, 20, 4, 0.0))) > 1.0, "where the twin was trained"


def test_it_is_not_learned_once_a_fan_has_a_baseline(scorer: FanScorer) -> None:
    before = {source: each.baseline.value.copy() for source, each in scorer.residuals.items()}
    scored(scorer, residual(3.0, 60, 2, UNSEEN_SIGMAS))
    for source, each in scorer.residuals.items():
        np.testing.assert_array_equal(each.baseline.value, before[source])


def test_a_fan_that_begins_there_is_judged() -> None:
    scorer = FanScorer(1, Limits.model_validate(CALIBRATION))
    assert np.isfinite(scored(scorer, residual(0.0, 10, 1, UNSEEN_SIGMAS))[5 * SECOND :]).all()


def test_the_limit_that_people_are_shown_is_the_wider_one(scorer: FanScorer) -> None:
    speed, learned = np.array([100.0]), scorer.residuals["speed"].baseline.learned_scale
    narrow, wide = (
        scorer.limit_at("speed", speed, 0, 0.01, learned, np.array([unseen]))[0] for unseen in (0.0, UNSEEN_SIGMAS)
    )
    assert wide > narrow + 2.9 * UNSEEN_SIGMAS


def test_a_fault_does_not_widen_its_own_limits() -> None:
    """A fan that needs twice the command for its speed: nobody has seen that pair, but both of a healthy fan."""
    off_the_diagonal = tuple(tuple(20.0 * (row != column) for column in range(3)) for row in range(3))
    table = by_speed((0.0, TWIN_SPEED, 2.0 * TWIN_SPEED), (0.0, NEEDED, 2.0 * NEEDED), off_the_diagonal, 0.0)
    prediction = prediction_of(np.zeros(1), balance=NEEDED)
    prediction = replace(prediction, predicted_speed_rad_s=2.0 * prediction.predicted_speed_rad_s)
    known = replace(of_twin(), table=table)
    assert known.of(prediction) == (0.0, 0.0)
    assert table.unseen_std_at(prediction.measured_speed_rad_s, prediction.command) == 20.0


@pytest.mark.parametrize(("beyond", "is_near"), [(-1.5, False), (-0.9, True), (1.9, True), (2.5, False)])
def test_around_the_end_of_a_plateau_a_drive_may_be_wrong(beyond: float, is_near: bool) -> None:
    """By a hundredth of the range of commands, 1 here, without a table too."""
    drive = DriveCard(turning_command=10.0, kick_s=0.5, rest_s=1.0, lowest_command=(NEEDED - beyond,))
    of_speed, of_balance = replace(of_twin(drive), table=None).of(prediction_of(np.zeros(1)))
    assert RANGE_STDS * of_balance == pytest.approx(1.0 if is_near else 0.0)
    slope = 0.05 + 2.0 * 0.0002 * TWIN_SPEED
    assert RANGE_STDS * of_speed * slope == pytest.approx(1.0 if is_near else 0.0)


def test_without_prediction_or_reading_it_adds_nothing() -> None:
    unknown = prediction_of(np.zeros(1), valid=np.zeros(1, np.bool_))
    assert of_twin().of(unknown)[1] == 0.0
    nothing = replace(unknown, predicted_speed_rad_s=np.full((1, 1), np.nan))
    assert of_twin().of(nothing) == (0.0, 0.0)
