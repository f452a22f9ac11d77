"""Error of a twin where it was not trained: it follows what a healthy fan does, and no fault makes it larger."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from schemas.twin_card import DriveCard
from scoring.unseen_error import RANGE_STDS, UnseenError
from tests.support.scored_blocks import NEEDED, TWIN_SPEED, prediction_of
from tests.support.uncertainty_tables import by_speed

TABLE = by_speed((0.0, 600.0), (0.0, 100.0), ((0.0, 0.0), (0.0, 20.0)), 0.0)
"""more at high speeds under high commands"""


def of_twin(drive: DriveCard | None = None) -> UnseenError:
    return UnseenError(TABLE, drive, viscous=np.array([0.05]), drag=np.array([0.0002]), command_width=100.0)


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
