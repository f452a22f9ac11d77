"""stages.twin_integrator: predictions never depend on how the grid is divided into messages."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fantwin import pipeline
from fantwin.pipeline.prediction import free_run, tray_integrator
from fantwin.pipeline.prediction.twin_file import TwinFile
from fantwin.schemas.enums import InvalidReason
from fantwin.schemas.fields import columns
from fantwin.schemas.messages import Grid, Prediction
from fantwin.stages.twin_integrator import TwinIntegratorCore
from tests.support.integrated_twins import (
    EPOCH_NS,
    NAN,
    STEP_NS,
    Floats,
    core_of,
    feed,
    grid_of,
    physical_twin,
    split,
    twin_with_friction,
)
from tests.support.twin_files import small_hybrid, write_twin

pytestmark = pytest.mark.usefixtures("one_reading_starts")

FANS = 8  # of the demo's twin
CONDITIONS = {"supply_voltage_v": 12.0, "temperature_c": 20.0}


def unstable_twin() -> TwinFile:
    """The speed of a fan is infinite from the sample after its command exceeds 85."""

    def advance(state: Floats, command: Floats, period_s: Floats) -> tuple[Floats, Floats]:
        assert np.isfinite(state).all()
        speed, now = np.empty_like(command), state[:, 0]
        for k, wanted in enumerate(command):
            speed[k], now = now, np.where(wanted > 85, np.inf, 0.9 * now + wanted)
        return speed, np.column_stack((now, command[-1]))

    return replace(physical_twin(FANS), advance_with=lambda _: advance)


@pytest.fixture(scope="module")
def twins(tmp_path_factory: pytest.TempPathFactory) -> dict[str, TwinFile]:
    folder = tmp_path_factory.mktemp("twins")
    return {
        "demo": TwinFile.load(Path(pipeline.__file__).parent / "demo" / "twin.onnx", FANS),
        "physical": TwinFile.load(write_twin(folder / "physical.onnx"), FANS),
        "hybrid": TwinFile.load(write_twin(folder / "hybrid.onnx", small_hybrid()), FANS),
        "unstable": unstable_twin(),
        "stiff": twin_with_friction(30.0, FANS),
        "allowing for supply and air": TwinFile.load(write_twin(folder / "air.onnx", conditions=CONDITIONS), FANS),
    }


WHAT_HAPPENS = (
    *("regular", "commands move", "no readings", "one reads at times", "one command unknown", "one far out"),
    *("off", "on and off", "short gap", "long gap", "stale"),
    *("some lost", "many lost", "off the grid", "again", "earlier"),
)


def grid_where(happenings: Iterable[tuple[str, int]], seed: int) -> Grid:
    """A grid with these happenings in order, each for its number of samples."""
    rng = np.random.default_rng(seed)
    t_ns, command, speed, invalid_reason = (
        [EPOCH_NS],
        [np.full(FANS, 40.0)],
        [np.zeros(FANS)],
        [np.zeros(FANS, np.uint8)],
    )
    for what, count in happenings:
        level = rng.uniform(0, 90, FANS)
        jumps = {"some lost": 20, "many lost": 80, "again": 0, "earlier": -3}
        for k in range(60 if what == "long gap" else count):
            t_ns.append(t_ns[-1] + jumps.get(what if k == 0 else "", 1) * STEP_NS)
            t_ns[-1] += int(rng.uniform(-0.6, 0.6) * STEP_NS) if what == "off the grid" else 0
            command.append(rng.uniform(0, 90, FANS) if what == "commands move" else level.copy())
            speed.append(rng.normal(100, 3, FANS))
            why = np.zeros(FANS, np.uint8)
            if what == "no readings" or (what == "one reads at times" and rng.random() < 0.6):
                why[0 if what == "one reads at times" else slice(None)] = InvalidReason.NO_SPEED
            if what in ("short gap", "long gap", "stale"):
                why[:] = InvalidReason.STALE if what == "stale" else InvalidReason.GAP
            if what == "one command unknown":
                command[-1][1] = NAN
            if what == "off" or (what == "on and off" and rng.random() < 0.5):
                command[-1][:4] = 10.0
            if what == "one far out":
                command[-1][2] = 150.0
            speed[-1][why > 0] = NAN
            invalid_reason.append(why)
    wander, is_there = np.cumsum(rng.normal(0.0, 0.1, (len(t_ns), 1)), axis=0), rng.random((len(t_ns), FANS)) > 0.2
    return Grid(
        fans=FANS,
        period_ns=STEP_NS,
        supply_voltage_v=np.where(is_there, 12.0 + 0.1 * wander, NAN).astype(np.float32),
        temperature_c=np.where(is_there, 20.0 + 3.0 * wander, NAN).astype(np.float32),
        t_ns=np.array(t_ns),
        command=np.array(command),
        speed_rad_s=np.array(speed),
        valid=np.array(invalid_reason) == 0,
        invalid_reason=np.array(invalid_reason),
    )


def predicted(core: TwinIntegratorCore, grids: Iterable[Grid]) -> tuple[Any, ...]:
    """All columns, to the bit, and the counters and problem of the core."""
    prediction = feed(core, grids)
    bits = {name: getattr(prediction, name).tobytes() for name in columns(Prediction)}
    return bits, core.counters(), core.problem()


@settings(max_examples=30, deadline=None)
@given(
    name=st.sampled_from(["demo", "physical", "hybrid", "unstable", "stiff", "allowing for supply and air"]),
    happenings=st.lists(st.tuples(st.sampled_from(WHAT_HAPPENS), st.integers(1, 30)), min_size=1, max_size=10),
    seed=st.integers(0, 1000),
    size=st.integers(2, 400),
    start_samples=st.integers(1, 6),
    hold_limit_ns=st.sampled_from([0, 5 * STEP_NS, 50 * STEP_NS]),
)
def test_blocks_of_any_size_are_predicted_the_same_to_the_bit(
    twins: dict[str, TwinFile],
    name: str,
    happenings: list[tuple[str, int]],
    seed: int,
    size: int,
    start_samples: int,
    hold_limit_ns: int,
) -> None:
    grid = grid_where(happenings, seed)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(free_run, "START_SAMPLES", start_samples)
        patch.setattr(tray_integrator, "HOLD_LIMIT_NS", hold_limit_ns)
        single, blocks = (predicted(core_of(twins[name], warm_up_s=0.05), split(grid, rows)) for rows in (1, size))
    assert single == blocks


def test_a_fan_that_diverges_within_a_block_restarts_from_the_next_reading() -> None:
    command = np.full((40, FANS), 40.0)
    command[10, 0] = command[25, 0] = 90.0
    core = core_of(unstable_twin())
    prediction = feed(core, [grid_of(command)])
    assert (core.counters()["diverged"], core.counters()["free_runs"]) == (2, FANS + 2)
    assert prediction.valid.all()
