"""Numbers of fans in a line for people."""

from __future__ import annotations

from collections.abc import Sequence

import pytest

from fantwin.schemas.fan_names import FanNames, fans_in_words


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


NAMES = FanNames(("CPU", "", "rear, top"))


@pytest.mark.parametrize(
    ("fans", "words"),
    [([0], "CPU (fan 0)"), ([1], "fan 1"), ([0, 1, 7], "CPU (fan 0), fan 1, fan 7"), (range(40), "fans 0 to 39")],
)
def test_a_fan_with_a_name_is_listed_by_it_unless_there_are_many(fans: Sequence[int], words: str) -> None:
    assert NAMES.labels(fans) == words


@pytest.mark.parametrize(
    ("text", "names"),
    [
        (NAMES.as_json(), NAMES.names),
        ('["a\\nb", 3, null, "  ", "\\u202egnp", "ok"]', ("", "", "", "", "", "ok")),
        (f'["{"x" * 61}"]', ("",)),
        *((text, ()) for text in ("", "{", "3", '{"0": "CPU"}', '"CPU"')),
    ],
)
def test_names_of_a_recording_that_cannot_be_shown_are_none(text: str, names: tuple[str, ...]) -> None:
    assert FanNames.from_json(text).names == names
