"""The twin's own error along a run: linear between the points of its table, constant beyond."""

import numpy as np
import pytest

from schemas.model_uncertainty import ModelUncertainty
from twin.evaluation.own_error import own_error_rad_s

TABLE = ModelUncertainty((0.0, 100.0, 200.0), (0.0, 1.0), ((1.0, 2.0), (3.0, 4.0), (5.0, 10.0)))


@pytest.mark.parametrize(
    ("speed_rad_s", "command", "std_rad_s"),
    [(0.0, 0.0, 1.0), (200.0, 1.0, 10.0), (50.0, 0.5, 2.5), (150.0, 1.0, 7.0), (-1e9, 0.5, 1.5), (1e9, 1e9, 10.0)],
)
def test_it_is_linear_between_its_points_and_constant_beyond(speed_rad_s, command, std_rad_s) -> None:
    assert own_error_rad_s(TABLE, np.array([speed_rad_s]), np.array([command])) == pytest.approx(std_rad_s)


def test_it_knows_nothing_of_an_unknown_speed() -> None:
    found = own_error_rad_s(TABLE, np.array([[np.nan, 50.0], [50.0, 50.0]]), np.array([[0.5, np.nan], [0.5, 0.5]]))
    np.testing.assert_array_equal(np.isnan(found), [[True, True], [False, False]])
