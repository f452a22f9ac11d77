"""Faults of the model: each row is named first when its own columns are planted, and a new kind is a row."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from fantwin.scoring.diagnosis.causes import CAUSES
from fantwin.scoring.model import decision
from fantwin.scoring.model.decision import Decision
from fantwin.scoring.model.faults import BEFORE_GROWTH, DRIVE, FALLS, FAULTS, RISES, SCALE, Fault
from fantwin.scoring.model.population import Priors
from tests.support.made_bins import MadeFans, bin_of, plays, with_reading
from tests.support.scored_blocks import twin_of

OF_TORQUE = [row for row in FAULTS if row.weight > 0.0]
OF_OWN_DRIVE = [row for row in FAULTS if row.of_own_drive > 0.0 and row.columns != (SCALE,)]
"""where a fan controls its speed, drag takes a share of it, as a wrong scale does: but for its lag they are alike"""


def moving(time_s: float) -> float:
    return 280.0 + 100.0 * math.sin(2.0 * math.pi * time_s / 40.0)


def first_causes(rows: Sequence[Fault], *, has_own_drive: bool) -> list[str]:
    """What is found first of fans with one of these faults each, of the size of its prior, or twice of what grows."""
    fans = replace(twin_of(len(rows)).fans, has_own_drive=np.full(len(rows), has_own_drive))
    made = MadeFans(fans, 0.2, moving, seed=1, own=0.3)
    deciding = made.decision()
    plays(made, deciding, 40.0)
    for fan, row in enumerate(rows):
        times = 2.0 if row.columns[0] in BEFORE_GROWTH else 1.0
        sizes = [row.mean or (row.sign or -1) * times * row.std[0], *(-std for std in row.std[1:])]
        made.sizes[fan, list(row.columns)] = sizes
    made.fault_from_s = 40.0
    plays(made, deciding, 60.0)
    causes = [deciding.alarms.causes(fan) for fan in range(len(rows))]
    return [each[0].cause if each else "no alarm" for each in causes]


@pytest.mark.parametrize(
    ("rows", "has_own_drive"), [(OF_TORQUE, False), (OF_OWN_DRIVE, True)], ids=["torque", "own drive"]
)
def test_each_fault_that_is_planted_by_its_own_columns_is_named_first_while_the_command_moves(
    rows: Sequence[Fault], has_own_drive: bool
) -> None:
    assert first_causes(rows, has_own_drive=has_own_drive) == [row.cause for row in rows]


def test_a_speed_that_no_rotor_makes_is_the_tachos_while_the_command_moves() -> None:
    fans = replace(twin_of(1).fans, pulse_rad_s=np.array([6.3]), held_s=np.array([0.5]))
    made = MadeFans(fans, 0.5, moving, seed=1)
    deciding = made.decision()
    plays(made, deciding, 40.0)
    plays(made, deciding, 20.0, lambda one: with_reading(one, 10.0 * fans.top_rad_s - one.predicted_rad_s))
    first, *_ = deciding.alarms.causes(0)
    assert (first.cause, first.probability > 0.99) == ("sensor_scaling", True)


def test_what_a_rotor_does_by_its_torque_balance_is_named_and_clears_while_the_command_steps_every_1_5_s() -> None:
    causes = ["gain_down", "drag_up", "external_torque"]
    fans = twin_of(len(causes)).fans
    deciding = Decision(fans, 100_000_000, 0.1, 100.0 * 86400.0, Priors())
    top = fans.top_rad_s
    of_top = (fans.viscous + fans.drag * top) * top + fans.friction
    gain, drag, brake = (np.array(each) for each in ([0.88, 1.0, 1.0], [1.0, 1.3, 1.0], [0.0, 0.0, 0.05]))
    rng, healthy, real = np.random.default_rng(3), 0.5 * top, 0.5 * top
    for number in range(1100):
        torque = of_top * (0.15 + 0.8 * ((number // 15) % 2))
        is_faulty = 300 <= number < 700
        for _ in range(20):
            needed = (fans.viscous + fans.drag * healthy) * healthy + fans.friction
            healthy = healthy + (torque - needed) / fans.inertia * 0.005
            own = (fans.viscous + np.where(is_faulty, drag, 1.0) * fans.drag * real) * real + fans.friction
            driven = np.where(is_faulty, gain * torque - brake * of_top, torque)
            real = real + (driven - own) / fans.inertia * 0.005
        one = bin_of(number, 100_000_000, len(causes), healthy, command=torque)
        deciding.take(with_reading(one, real - healthy + rng.normal(0.0, fans.noise_rad_s)))
        if number == 699:
            assert [deciding.alarms.causes(fan)[0].cause for fan in range(len(causes))] == causes
    assert deciding.active.tolist()[:2] == [False, False], "40 s after the repair"


def test_a_new_kind_of_fault_is_one_row(monkeypatch: pytest.MonkeyPatch) -> None:
    toy = Fault("weak when it speeds up", (DRIVE, RISES, FALLS), (0.1, 1.0, 0.1), -1, 0.0, 0.05, 0.05)
    monkeypatch.setattr(decision, "FAULTS", (*FAULTS, toy))
    assert first_causes([toy], has_own_drive=False) == [toy.cause]


def test_rows_have_words_and_their_probabilities_add_up_to_one() -> None:
    assert {row.cause for row in FAULTS} <= set(CAUSES)
    assert sum(row.weight for row in FAULTS) == pytest.approx(1.0, abs=0.03)
    assert sum(row.of_own_drive for row in FAULTS) == pytest.approx(1.0, abs=0.03)
    assert all(len(row.columns) == len(row.std) for row in FAULTS)
