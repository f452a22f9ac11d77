"""The table of a twin's own error in its card."""

from dataclasses import replace

import numpy as np
import pytest
from pydantic import ValidationError

from fantwin.schemas.model_uncertainty import ModelUncertainty
from tests.support.uncertainty_tables import by_speed

STD_RAD_S = ((1.0, 2.0), (3.0, 4.0), (5.0, 10.0))
TABLE = by_speed((0.0, 100.0, 200.0), (0.0, 1.0), STD_RAD_S, 10.0)
"""of one fan, that settles at 0"""
OF_FANS = ModelUncertainty(
    (0.0, 1.0),
    (0.0, 100.0, 200.0),
    (STD_RAD_S, tuple(tuple(2.0 * value for value in row) for row in STD_RAD_S)),
    seen_std_rad_s=(3.0, 9.0),
    settled_speed_rad_s=((0.0, 0.2, 0.4), (0.0, 10.0, 20.0)),
)


@pytest.mark.parametrize(
    ("speeds_rad_s", "commands", "std_rad_s", "words"),
    [
        ((0.0,), (0.0, 1.0), ((1.0, 1.0),), "two of each at least"),
        ((1.0, 0.0), (0.0, 1.0), ((1.0, 1.0), (1.0, 1.0)), "rising"),
        ((0.0, 1.0), (0.0, 1.0), ((1.0, 1.0),), "a value for each command and speed"),
        ((0.0, 1.0), (0.0, 1.0), ((1.0, -1.0), (1.0, 1.0)), "none below zero"),
    ],
)
def test_another_table_is_refused(speeds_rad_s, commands, std_rad_s, words: str) -> None:
    with pytest.raises(ValidationError, match=words):
        by_speed(speeds_rad_s, commands, std_rad_s, 1.0)


def test_values_that_do_not_fit_the_tables_are_refused() -> None:
    with pytest.raises(ValidationError, match="seen_std_rad_s must have a value for each table, none below zero"):
        replace(TABLE, seen_std_rad_s=(-1.0,))
    with pytest.raises(ValidationError, match="seen_std_rad_s must have a value for each table"):
        replace(TABLE, seen_std_rad_s=(1.0, 1.0))
    with pytest.raises(ValidationError, match="settled_speed_rad_s must have a speed for each command of each fan"):
        replace(OF_FANS, settled_speed_rad_s=((0.0, 0.2, 0.4), (0.0, 10.0)))


@pytest.mark.parametrize(
    ("speed_rad_s", "command", "std_rad_s"),
    [(0.0, 0.0, 1.0), (200.0, 1.0, 10.0), (50.0, 0.5, 2.5), (150.0, 1.0, 7.0), (-1e9, 0.5, 1.5), (1e9, 1e9, 10.0)],
)
def test_it_is_linear_between_its_points_and_constant_beyond(speed_rad_s, command, std_rad_s) -> None:
    assert TABLE.std_at(np.array([speed_rad_s]), np.array([command])) == pytest.approx(std_rad_s)


def test_only_what_training_has_not_shown_is_unseen() -> None:
    table, speeds_rad_s, command = (
        replace(TABLE, seen_std_rad_s=(3.0,)),
        np.array([[50.0], [100.0], [200.0]]),
        np.zeros((3, 1)),
    )
    np.testing.assert_allclose(table.unseen_std_at(speeds_rad_s, command), [[0.0], [0.0], [4.0]])  # of 2, 3 and 5
    np.testing.assert_array_equal(TABLE.unseen_std_at(speeds_rad_s, command), 0.0, "all is seen")


def test_each_fan_has_its_own_around_the_speeds_at_which_it_settles() -> None:
    command, speed_rad_s = np.full((3, 2), 150.0), np.array([[0.3, 15.0], [0.8, 15.5], [1.3, 99.0]])
    expected = np.array([[4.0, 8.0], [5.5, 11.0], [7.0, 14.0]])
    np.testing.assert_allclose(OF_FANS.std_at(speed_rad_s, command), expected)
    np.testing.assert_allclose(
        OF_FANS.unseen_std_at(speed_rad_s, command), np.sqrt(np.maximum(expected**2 - np.square((3.0, 9.0)), 0.0))
    )
    np.testing.assert_allclose(OF_FANS.of_fans([1]).std_at(speed_rad_s[:, 1:], command[:, 1:]), expected[:, 1:])
    assert TABLE.of_fans([0, 0, 0]).std_at(np.zeros((1, 3)), np.ones((1, 3))).shape == (1, 3), "one holds for any fan"
