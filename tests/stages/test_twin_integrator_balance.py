"""stages.twin_integrator: the torque balance, and twins that need the supply voltage and the temperature."""

from __future__ import annotations

from dataclasses import asdict, replace
from typing import Any

import numpy as np
import pytest

from fantwin.pipeline.prediction.twin_file import TwinFile
from fantwin.schemas.blocks import cut
from fantwin.schemas.enums import InvalidReason
from fantwin.schemas.messages import Array, Grid, Prediction
from fantwin.schemas.reference_conditions import ReferenceConditions
from fantwin.schemas.twin_card import DriveCard
from fantwin.schemas.units import NS_PER_S
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
from tests.support.twin_files import SIGMA_COMMAND, write_twin

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


FANS, RATE_HZ = 2, 50
PERIOD_NS = NS_PER_S // RATE_HZ
REFERENCE = ReferenceConditions(supply_voltage_v=12.0, temperature_c=20.0)
UNKNOWN, WARMING_UP = int(InvalidReason.CONDITIONS_UNKNOWN), int(InvalidReason.WARMING_UP)


@pytest.fixture(scope="module")
def twin(tmp_path_factory: pytest.TempPathFactory) -> TwinFile:
    return TwinFile.load(write_twin(tmp_path_factory.mktemp("twins") / "t.onnx", conditions=asdict(REFERENCE)), FANS)


@pytest.fixture(scope="module")
def plain_twin(tmp_path_factory: pytest.TempPathFactory) -> TwinFile:
    return TwinFile.load(write_twin(tmp_path_factory.mktemp("twins") / "t.onnx"), FANS)


def run_of(seconds: float, supply_v: Array | float | None, temperature_c: Array | float | None, seed: int = 1) -> Grid:
    """Commands that move, and speeds that are not compared here."""
    samples = round(seconds * RATE_HZ)
    values: dict[str, Any] = {
        name: np.broadcast_to(np.reshape(np.asarray(value, np.float32), (-1, 1)), (samples, FANS)).copy()
        for name, value in (("supply_voltage_v", supply_v), ("temperature_c", temperature_c))
        if value is not None
    }
    speed = 100.0 + np.random.default_rng(seed).normal(0.0, 1.0, (samples, FANS))
    return replace(grid_of(35.0 + stairs(samples, FANS, seed) / 5.0, speed, period_ns=PERIOD_NS), **values)


def predicted(twin: TwinFile, grid: Grid) -> Prediction:
    return feed(core_of(twin, warm_up_s=1.0), [grid])


def test_at_the_reference_it_is_the_twin_that_needs_nothing(twin: TwinFile, plain_twin: TwinFile) -> None:
    mine = predicted(twin, run_of(20.0, 12.0, 20.0))
    plain = predicted(plain_twin, run_of(20.0, None, None))
    for name in ("predicted_speed_rad_s", "torque_balance_command", "valid", "invalid_reason"):
        np.testing.assert_array_equal(getattr(mine, name), getattr(plain, name), err_msg=name)


def test_torque_follows_the_supply_and_drag_the_density_of_the_air(twin: TwinFile, plain_twin: TwinFile) -> None:
    """The same speeds as of fans with other parameters: a command r times as large, a drag d times as large."""
    grid = run_of(20.0, 10.8, 40.0)
    r, d = 10.8 / 12.0, 293.15 / 313.15
    parameters = plain_twin.parameters * [1.0, 1.0, d, *np.ones(plain_twin.parameters.shape[1] - 3)]
    other = replace(plain_twin, parameters=parameters)
    expected = predicted(other, replace(grid, command=r * grid.command))
    mine = predicted(twin, grid)
    np.testing.assert_allclose(mine.predicted_speed_rad_s, expected.predicted_speed_rad_s, rtol=1e-6)
    np.testing.assert_array_equal(mine.command, grid.command)
    noise = 25.0 + np.random.default_rng(6).uniform(-0.4, 0.4, 10 * RATE_HZ)
    of_noise = predicted(twin, run_of(10.0, 12.0, noise)).air_density_ratio
    assert len(np.unique(of_noise)) == 1, "noise of the temperature does not shake the prediction"


def test_a_column_that_does_not_come_is_said_and_nothing_is_judged(twin: TwinFile) -> None:
    core = core_of(twin, warm_up_s=1.0)
    prediction = feed(core, [run_of(5.0, 12.0, None)])
    assert (prediction.invalid_reason == UNKNOWN).all()
    assert not prediction.valid.any()
    assert "needs temperature_c, which the source does not send" in core.problem()
    (note,) = core.notes()
    assert note.endswith("allows for supply voltage (reference 12 V) and temperature (reference 20 °C)")


def test_a_value_that_stays_away_is_held_for_five_seconds_then_nothing_is_judged_until_it_is_back(
    twin: TwinFile,
) -> None:
    supply_v = np.full(20 * RATE_HZ, 12.0)
    supply_v[5 * RATE_HZ : 15 * RATE_HZ] = np.nan
    prediction = predicted(twin, run_of(20.0, supply_v, 20.0))
    reason = prediction.invalid_reason[:, 0]
    last_known = 5 * RATE_HZ - 1
    unknown = np.arange(last_known + 5 * RATE_HZ + 1, 15 * RATE_HZ)
    np.testing.assert_array_equal(np.flatnonzero(reason == UNKNOWN), unknown)
    assert (reason[15 * RATE_HZ : 16 * RATE_HZ - 1] == WARMING_UP).all()
    assert prediction.valid[16 * RATE_HZ :].all()
    assert np.isnan(prediction.torque_balance_command[unknown]).all()


def test_a_supply_that_takes_commands_out_of_the_twins_range_is_said(twin: TwinFile) -> None:
    supply_v = np.where(np.arange(20 * RATE_HZ) < 10 * RATE_HZ, 12.0, 60.0)
    grid = run_of(20.0, supply_v, 20.0)
    before, after = cut(grid, 0, 10 * RATE_HZ), cut(grid, 10 * RATE_HZ, len(grid.t_ns))
    core = core_of(twin, warm_up_s=1.0)
    feed(core, [before])
    assert core.problem() == ""
    assert (feed(core, [after]).invalid_reason == int(InvalidReason.OUT_OF_RANGE)).any()
    line = "fans 0, 1 are not scored: a supply of 60 V, where the twin's reference is 12 V, takes the command out of"
    assert core.problem().startswith(line)
    later = replace(before, t_ns=grid.t_ns[-1] + PERIOD_NS + before.t_ns - before.t_ns[0])
    feed(core, [later])
    assert core.problem() == "", "the supply is back"
    other = core_of(twin, warm_up_s=1.0)
    feed(other, [replace(grid, command=grid.command * 5.0, supply_voltage_v=np.full_like(grid.command, 12.0))])
    assert other.problem() == "", "the commands themselves are out of range"
