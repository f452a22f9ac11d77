"""The table of a twin's own error in its card."""

from dataclasses import replace

import numpy as np
import pytest
from pydantic import ValidationError

from schemas.model_uncertainty import ModelUncertainty

TABLE = ModelUncertainty((0.0, 100.0, 200.0), (0.0, 1.0), ((1.0, 2.0), (3.0, 4.0), (5.0, 10.0)))


@pytest.mark.parametrize(
    ("speeds_rad_s", "commands", "std_rad_s", "words"),
    [
        ((0.0,), (0.0, 1.0), ((1.0, 1.0),), "two of each at least"),
        ((1.0, 0.0), (0.0, 1.0), ((1.0, 1.0), (1.0, 1.0)), "rising"),
        ((0.0, 1.0), (0.0, 1.0), ((1.0, 1.0),), "a row for each speed"),
        ((0.0, 1.0), (0.0, 1.0), ((1.0, -1.0), (1.0, 1.0)), "none below zero"),
    ],
)
def test_another_table_is_refused(speeds_rad_s, commands, std_rad_s, words: str) -> None:
    with pytest.raises(ValidationError, match=words):
        ModelUncertainty(speeds_rad_s, commands, std_rad_s)


def test_a_level_below_zero_is_refused() -> None:
    with pytest.raises(ValidationError, match="seen_std_rad_s must not be below zero"):
        replace(TABLE, seen_std_rad_s=-1.0)


@pytest.mark.parametrize(
    ("speed_rad_s", "command", "std_rad_s"),
    [(0.0, 0.0, 1.0), (200.0, 1.0, 10.0), (50.0, 0.5, 2.5), (150.0, 1.0, 7.0), (-1e9, 0.5, 1.5), (1e9, 1e9, 10.0)],
)
def test_it_is_linear_between_its_points_and_constant_beyond(speed_rad_s, command, std_rad_s) -> None:
    assert TABLE.std_at(np.array([speed_rad_s]), np.array([command])) == pytest.approx(std_rad_s)


def test_it_knows_nothing_of_an_unknown_speed() -> None:
    found = TABLE.std_at(np.array([[np.nan, 50.0], [50.0, 50.0]]), np.array([[0.5, np.nan], [0.5, 0.5]]))
    np.testing.assert_array_equal(np.isnan(found), [[True, True], [False, False]])


def test_only_what_training_has_not_shown_is_unseen() -> None:
    table, speeds_rad_s, command = replace(TABLE, seen_std_rad_s=3.0), np.array([50.0, 100.0, 200.0]), np.zeros(3)
    np.testing.assert_allclose(table.unseen_std_at(speeds_rad_s, command), [0.0, 0.0, 4.0])  # of 2, 3 and 5
    np.testing.assert_array_equal(TABLE.unseen_std_at(speeds_rad_s, command), 0.0, "early cards do not say")
