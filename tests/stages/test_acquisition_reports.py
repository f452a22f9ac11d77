"""Acquisition: what its limits refuse is said in one short line that stays the same, with the setting to correct."""

from __future__ import annotations

import random
from itertools import pairwise

import numpy as np
import pytest

from fantwin.pipeline.sources.serial.port import ReceivedBytes
from fantwin.schemas.units import NS_PER_S as S
from fantwin.schemas.wire import encode
from tests.stages.test_acquisition import feed, make_core, sample


def test_a_command_at_a_limit_that_float32_rounds_beyond_it_is_no_absurd_one() -> None:
    assert float(np.float32(0.1)) > 0.1
    for command in (-0.1, 0.3):
        assert len(feed(make_core(command_max=0.3, command_min=-0.1), [sample(0, command=command)])) == 1


@pytest.mark.parametrize(
    ("is_command", "fault", "settings"),
    [
        (
            True,
            "absurd_command: command 100 is outside command_min = 0 to command_max = 1",
            "command_min and command_max",
        ),
        (False, "absurd_speed: speed 100 is beyond speed_max = 40 rpm", "speed_max and speed_unit"),
    ],
    ids=["command", "speed"],
)
def test_samples_beyond_a_limit_are_one_problem_that_names_it_whatever_their_values(
    is_command: bool, fault: str, settings: str
) -> None:
    core, problems = make_core(speed_max=40, speed_unit="rpm"), set[str]()
    for number in range(200):
        beyond = 100.0 + number % 50
        made = sample(number, command=beyond) if is_command else sample(number, speed=beyond)
        feed(core, [made], t_ns=number * S // 10)
        core.tick(number * S // 10)
        problems.add(core.problem())
    assert problems == {"", f"/dev/ttyTEST: no valid sample ({fault}); check {settings} of the [[tray]]"}


def test_input_of_which_about_a_half_is_faulty_is_one_problem_that_does_not_come_and_go() -> None:
    chance, core, seen = random.Random(3), make_core(), [""]
    for number in range(600):
        good = encode("binary", sample(number))
        core.step(ReceivedBytes(chance.choice((good, good[:9] + b"\0")), S))
        seen.append(core.problem())
    assert [now for before, now in pairwise(seen) if now != before] == seen[-1:]
    assert "most input is faulty" in seen[-1]


def test_a_long_piece_is_quoted_in_part_only() -> None:
    core = make_core(protocol="text")
    for piece in (b"\n", b"S 1 2 0.5 " + b"x" * 4900 + b"\n"):
        core.step(ReceivedBytes(piece, 3 * S))
    (note,) = core.notes()
    core.tick(3 * S)
    for text in (note, core.problem()):
        assert "xxx..." in text and len(text) < 250
