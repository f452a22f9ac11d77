"""Error of a twin where it was not trained: it follows what a healthy fan does, and no fault makes it larger."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fantwin.scoring.unseen_error import UnseenError
from tests.support.scored_blocks import NEEDED, TWIN_SPEED, prediction_of
from tests.support.uncertainty_tables import by_speed

TABLE = by_speed((0.0, 600.0), (0.0, 100.0), ((0.0, 0.0), (0.0, 20.0)), 0.0)
"""more at high speeds under high commands"""


def of_twin() -> UnseenError:
    return UnseenError(TABLE, None, viscous=np.array([0.05]), drag=np.array([0.0002]))


def test_a_fault_does_not_widen_its_own_limits() -> None:
    """A fan that needs twice the command for its speed: nobody has seen that pair, but both of a healthy fan."""
    off_the_diagonal = tuple(tuple(20.0 * (row != column) for column in range(3)) for row in range(3))
    table = by_speed((0.0, TWIN_SPEED, 2.0 * TWIN_SPEED), (0.0, NEEDED, 2.0 * NEEDED), off_the_diagonal, 0.0)
    prediction = prediction_of(np.zeros(1), balance=NEEDED)
    prediction = replace(prediction, predicted_speed_rad_s=2.0 * prediction.predicted_speed_rad_s)
    known = replace(of_twin(), table=table)
    assert known.of(prediction) == (0.0, 0.0)
    assert table.unseen_std_at(prediction.measured_speed_rad_s, prediction.command) == 20.0
