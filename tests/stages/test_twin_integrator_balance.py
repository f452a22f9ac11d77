"""stages.twin_integrator: the torque balance beside the prediction."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fantwin.schemas.blocks import cut
from fantwin.schemas.enums import InvalidReason
from fantwin.schemas.messages import Grid
from fantwin.schemas.twin_card import DriveCard
from tests.support.integrated_twins import (
    NAN,
    STEP_NS,
    Floats,
    core_of,
    feed,
    grid_of,
    physical_twin,
    run_freely,
    silent,
    stairs,
    twin_with_friction,
)
from tests.support.twin_files import SIGMA_COMMAND

pytestmark = pytest.mark.usefixtures("one_reading_starts")

SETTLES = 31
"""samples until it is known: a third of a second"""


def healthy(samples: int = 400, extra: float = 0.0) -> Grid:
    """A fan that agrees with the card of the twin, on stairs; `extra` is added to its command in the second half."""
    command = stairs(samples) + 20.0
    start = np.array([[100.0, command[0, 0]]])
    speed, _ = run_freely(start, command, np.full(samples, STEP_NS / 1e9))
    command = command + extra * (np.arange(samples) >= samples // 2)[:, np.newaxis]
    return grid_of(command, speed)


def balance(grids: list[Grid], friction: float = 0.0) -> Floats:
    twin = twin_with_friction(friction) if friction else physical_twin()
    return feed(core_of(twin), grids).torque_balance_command[:, 0]


def test_the_balance_of_a_healthy_fan_is_zero_and_additional_command_shows_in_it() -> None:
    found = balance([healthy()])
    assert np.isnan(found[: SETTLES - 1]).all() and np.isfinite(found[SETTLES:]).all()
    assert np.abs(found[SETTLES:]).max() < 0.3
    assert balance([healthy(extra=5.0)])[-1] == pytest.approx(5.0, abs=0.3)
    prediction = feed(core_of(physical_twin(2)), [grid_of(stairs(5, 2))])
    assert prediction.torque_balance_sigma_command.tolist() == [SIGMA_COMMAND] * 2


def test_the_balance_of_a_fan_whose_drive_keeps_it_on_a_plateau_is_zero() -> None:
    given = stairs(400) + 20.0
    raised = np.maximum(given, 50.0)
    assert np.any(raised > given)
    speed, _ = run_freely(np.array([[100.0, raised[0, 0]]]), raised, np.full(400, STEP_NS / 1e9))
    drive = DriveCard(turning_command=5.0, kick_s=0.6, rest_s=2.0, lowest_command=(50.0,))
    prediction = feed(core_of(physical_twin(drive=drive)), [grid_of(given, speed)])
    assert np.abs(prediction.torque_balance_command[SETTLES:]).max() < 0.3
    np.testing.assert_array_equal(prediction.averaged_command, raised)
    np.testing.assert_array_equal(prediction.command, given)
    assert np.abs(feed(core_of(), [grid_of(given, speed)]).torque_balance_command[SETTLES:]).max() > 5.0


def where_known(found: Floats) -> list[int]:
    """First and last sample of each stretch in which it is present."""
    edges = np.flatnonzero(np.diff(np.isfinite(found).astype(int), prepend=0, append=0))
    return [int(edge) for edge in edges]


def test_after_missing_samples_the_balance_starts_again() -> None:
    grid = healthy()
    first, second = cut(grid, 0, 225), cut(grid, 225, 400)  # in the middle of a stair: the lag has settled
    jumped = replace(second, t_ns=second.t_ns + 10 * STEP_NS)
    one_block = replace(grid, t_ns=np.concatenate((first.t_ns, jumped.t_ns)))
    for grids in ([first, jumped], [one_block]):
        found = balance(grids)
        begins, ends, again, end = where_known(found)
        assert (ends, end) == (225, 400)
        assert again - 225 == begins == SETTLES
        assert np.abs(found[again:]).max() < 0.3


def test_without_a_reading_a_command_or_samples_there_is_no_balance_and_it_starts_again() -> None:
    for column in ("speed_rad_s", "command"):
        grid = healthy()
        getattr(grid, column)[200] = NAN
        found = balance([grid])
        assert where_known(found) == [SETTLES, 200, 201 + SETTLES, 400]
    found = balance([healthy(200), silent(50, 200, 40.0), silent(50, 250, 40.0, InvalidReason.STALE)])
    assert where_known(found) == [SETTLES, 200]


def test_there_is_no_balance_while_the_drive_is_off() -> None:
    grid = healthy()
    grid.command[200:220] = 1.0
    found = balance([grid], friction=5.0)
    begins, ends, again, end = where_known(found)
    assert (begins, ends, end) == (SETTLES, 200, 400)
    assert again >= 220 + SETTLES


def test_there_is_no_balance_far_above_the_training_speeds() -> None:
    twin = physical_twin(speed_range_rad_s=(0.0, 200.0))
    fast = grid_of(np.full(100, 60.0), np.full(100, 301.0))
    slower = grid_of(np.full(100, 60.0), np.full(100, 299.0))
    assert np.isnan(feed(core_of(twin), [fast]).torque_balance_command).all()
    assert np.isfinite(feed(core_of(twin), [slower]).torque_balance_command[SETTLES:]).all()
