"""Numbers of fans in a line for people."""

from __future__ import annotations

from collections.abc import Sequence

import pytest

from fantwin.schemas.fan_names import fans_in_words


@pytest.mark.parametrize(
    ("fans", "words"),
    [
        ([3], "3"),
        ([0, 1, 2, 7], "0, 1, 2, 7"),
        (range(40), "0 to 39"),
        ([*range(5), 7, *range(9, 12)], "0 to 4, 7, 9 to 11"),
        (range(0, 1024, 2), "0, 2, 4, 6, 8, 10, 12, 14 and 504 more"),
    ],
)
def test_many_fans_are_named_in_runs_and_as_many_as_fit_a_line(fans: Sequence[int], words: str) -> None:
    assert fans_in_words(fans) == words
