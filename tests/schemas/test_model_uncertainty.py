"""The table of a twin's own error in its card."""

import pytest
from pydantic import ValidationError

from schemas.model_uncertainty import ModelUncertainty


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
