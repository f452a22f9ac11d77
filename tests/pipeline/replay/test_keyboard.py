"""The keys of a terminal, and that the terminal is restored."""

from __future__ import annotations

import sys

import pytest

from fantwin.pipeline.replay.live.keyboard import Key, Keys, keys_in


@pytest.mark.parametrize(
    ("typed", "keys"),
    [
        (b" ", [Key.PAUSE]),
        (b"s\x1b[C\x1bOC", [Key.STEP] * 3),
        (b"\x1b[A\x1bOA", [Key.FASTER] * 2),
        (b"\x1b[B\x1bOB", [Key.SLOWER] * 2),
        (b"xyz\tq", [Key.QUIT]),
        (b"\x1b[Dq", [Key.QUIT]),
        (b"\x1b\x1b[A", [Key.FASTER]),
    ],
)
def test_keys_and_both_manners_of_arrows_are_known_and_all_else_is_passed_over(typed, keys):
    assert keys_in(typed) == keys


def test_without_a_terminal_there_are_no_keys(monkeypatch, tmp_path):
    with (tmp_path / "input").open("w+") as no_terminal:
        monkeypatch.setattr(sys, "stdin", no_terminal)
        keys = Keys()
        assert not keys.is_available
        with keys:
            assert keys.pressed() == []
