"""stages.twin_integrator: a twin that needs the supply voltage and the temperature of the air."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np
import pytest

from fantwin.pipeline.prediction.joint_tray_integrator import JointTrayIntegrator
from fantwin.pipeline.prediction.tray_integrator import TwinIntegratorConfig
from fantwin.pipeline.prediction.twin_file import TwinFile
from fantwin.schemas.blocks import cut, join
from fantwin.schemas.enums import InvalidReason
from fantwin.schemas.fields import columns
from fantwin.schemas.messages import Array, Grid, Prediction
from fantwin.schemas.reference_conditions import ReferenceConditions
from fantwin.schemas.units import NS_PER_S
from fantwin.stages.twin_integrator import TwinIntegratorCore
from tests.support.twin_files import write_twin

FANS, RATE_HZ = 2, 50
STEP_NS = NS_PER_S // RATE_HZ
EPOCH_NS = 1_700_000_000 * NS_PER_S
REFERENCE = ReferenceConditions(supply_voltage_v=12.0, temperature_c=20.0)
UNKNOWN, WARMING_UP = int(InvalidReason.CONDITIONS_UNKNOWN), int(InvalidReason.WARMING_UP)


@pytest.fixture(scope="module")
def twin(tmp_path_factory: pytest.TempPathFactory) -> TwinFile:
    return TwinFile.load(write_twin(tmp_path_factory.mktemp("twins") / "t.onnx", conditions=asdict(REFERENCE)), FANS)


@pytest.fixture(scope="module")
def plain_twin(tmp_path_factory: pytest.TempPathFactory) -> TwinFile:
    return TwinFile.load(write_twin(tmp_path_factory.mktemp("twins") / "t.onnx"), FANS)


def grid_of(seconds: float, supply_v: Array | float | None, temperature_c: Array | float | None, seed: int = 1) -> Grid:
    """Commands that move, and speeds that are not compared here."""
    samples = round(seconds * RATE_HZ)
    rng = np.random.default_rng(seed)
    command = np.repeat(rng.uniform(35.0, 55.0, (-(-samples // 25), FANS)), 25, axis=0)[:samples]
    values: dict[str, Any] = {
        name: np.broadcast_to(np.reshape(np.asarray(value, np.float32), (-1, 1)), (samples, FANS)).copy()
        for name, value in (("supply_voltage_v", supply_v), ("temperature_c", temperature_c))
        if value is not None
    }
    return Grid(
        fans=FANS,
        period_ns=STEP_NS,
        t_ns=EPOCH_NS + np.arange(samples) * STEP_NS,
        command=command,
        speed_rad_s=100.0 + rng.normal(0.0, 1.0, (samples, FANS)),
        valid=np.ones((samples, FANS), np.bool_),
        invalid_reason=np.zeros((samples, FANS), np.uint8),
        reading_missing=np.zeros((samples, FANS), np.bool_),
        **values,
    )


def core_of(twin: TwinFile) -> TwinIntegratorCore:
    return TwinIntegratorCore(twin, TwinIntegratorConfig(start_samples=1, warm_up_s=1.0), 0)


def predicted(core: TwinIntegratorCore, grids: Sequence[Grid]) -> Prediction:
    return join([made for grid in grids for made in core.step(grid) if isinstance(made, Prediction)])


def same_bits(one: Prediction, other: Prediction) -> None:
    for name in columns(Prediction):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)


def test_at_the_reference_it_is_the_twin_that_needs_nothing(twin: TwinFile, plain_twin: TwinFile) -> None:
    mine = predicted(core_of(twin), [grid_of(20.0, 12.0, 20.0)])
    plain = predicted(core_of(plain_twin), [grid_of(20.0, None, None)])
    for name in ("predicted_speed_rad_s", "torque_balance_command", "valid", "invalid_reason"):
        np.testing.assert_array_equal(getattr(mine, name), getattr(plain, name), err_msg=name)


def test_torque_follows_the_supply_and_drag_the_density_of_the_air(twin: TwinFile, plain_twin: TwinFile) -> None:
    """The same speeds as of fans with other parameters: a command r times as large, a drag d times as large."""
    grid = grid_of(20.0, 10.8, 40.0)
    r, d = 10.8 / 12.0, 293.15 / 313.15
    parameters = plain_twin.parameters * [1.0, 1.0, d, *np.ones(plain_twin.parameters.shape[1] - 3)]
    other = replace(plain_twin, parameters=parameters)
    expected = predicted(core_of(other), [replace(grid, command=r * grid.command)])
    mine = predicted(core_of(twin), [grid])
    np.testing.assert_allclose(mine.predicted_speed_rad_s, expected.predicted_speed_rad_s, rtol=1e-6)
    np.testing.assert_array_equal(mine.command, grid.command)


def wandering(seconds: float, seed: int = 2) -> Grid:
    """Supply and air that wander, with values that are missing here and there."""
    rng = np.random.default_rng(seed)
    samples = round(seconds * RATE_HZ)
    supply_v = 12.0 + np.cumsum(rng.normal(0.0, 0.02, samples))
    temperature_c = 20.0 + np.cumsum(rng.normal(0.0, 0.5, samples))
    supply_v[rng.random(samples) < 0.2] = np.nan
    temperature_c[rng.random(samples) < 0.9] = np.nan
    temperature_c[0] = 20.0
    return grid_of(seconds, supply_v, temperature_c, seed)


def test_how_the_grid_is_divided_into_messages_makes_no_difference(twin: TwinFile, size: int = 7) -> None:
    grid = wandering(12.0)
    samples = len(grid.t_ns)
    pieces = [cut(grid, first, min(first + size, samples)) for first in range(0, samples, size)]
    assert len(np.unique(predicted(core_of(twin), [grid]).air_density_ratio)) > 5
    noise = 25.0 + np.random.default_rng(6).uniform(-0.4, 0.4, 10 * RATE_HZ)
    of_noise = predicted(core_of(twin), [grid_of(10.0, 12.0, noise)]).air_density_ratio
    assert len(np.unique(of_noise)) == 1, "noise of the temperature does not shake the prediction"
    same_bits(predicted(core_of(twin), pieces), predicted(core_of(twin), [grid]))


def test_trays_that_are_predicted_together_get_what_each_gets_alone(twin: TwinFile) -> None:
    grids = [wandering(6.0, seed) for seed in (3, 4, 5)]
    alone = [predicted(core_of(twin), [grid]) for grid in grids]
    together, cores = JointTrayIntegrator(), [core_of(twin) for _ in grids]
    made: list[list[Prediction]] = [[] for _ in grids]
    for first in range(0, 300, 10):
        blocks = [core.admit(cut(grid, first, first + 10)).block for core, grid in zip(cores, grids, strict=True)]
        keys = {core.tray.joint_key(block) for core, block in zip(cores, blocks, strict=True)}
        assert first == 0 or (len(keys) == 1 and None not in keys)
        if first == 0:
            of_each = [core.tray.predict(block) for core, block in zip(cores, blocks, strict=True)]
        else:
            of_each = together.predict([core.tray for core in cores], blocks)
        for mine, prediction in zip(made, of_each, strict=True):
            mine.append(prediction)
    for mine, expected in zip(made, alone, strict=True):
        same_bits(join(mine), expected)


def test_a_column_that_does_not_come_is_said_and_nothing_is_judged(twin: TwinFile) -> None:
    core = core_of(twin)
    prediction = predicted(core, [grid_of(5.0, 12.0, None)])
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
    prediction = predicted(core_of(twin), [grid_of(20.0, supply_v, 20.0)])
    reason = prediction.invalid_reason[:, 0]
    last_known = 5 * RATE_HZ - 1
    unknown = np.arange(last_known + 5 * RATE_HZ + 1, 15 * RATE_HZ)
    np.testing.assert_array_equal(np.flatnonzero(reason == UNKNOWN), unknown)
    assert (reason[15 * RATE_HZ : 16 * RATE_HZ - 1] == WARMING_UP).all()
    assert prediction.valid[16 * RATE_HZ :].all()
    assert np.isnan(prediction.torque_balance_command[unknown]).all()


def test_a_supply_that_takes_commands_out_of_the_twins_range_is_said(twin: TwinFile) -> None:
    supply_v = np.where(np.arange(20 * RATE_HZ) < 10 * RATE_HZ, 12.0, 60.0)
    grid = grid_of(20.0, supply_v, 20.0)
    before, after = cut(grid, 0, 10 * RATE_HZ), cut(grid, 10 * RATE_HZ, len(grid.t_ns))
    core = core_of(twin)
    predicted(core, [before])
    assert core.problem() == ""
    assert (predicted(core, [after]).invalid_reason == int(InvalidReason.OUT_OF_RANGE)).any()
    line = "fans 0, 1 are not scored: a supply of 60 V, where the twin's reference is 12 V, takes the command out of"
    assert core.problem().startswith(line)
    later = replace(before, t_ns=grid.t_ns[-1] + STEP_NS + before.t_ns - before.t_ns[0])
    predicted(core, [later])
    assert core.problem() == "", "the supply is back"
    other = core_of(twin)
    predicted(other, [replace(grid, command=grid.command * 5.0, supply_voltage_v=np.full_like(grid.command, 12.0))])
    assert other.problem() == "", "the commands themselves are out of range"
