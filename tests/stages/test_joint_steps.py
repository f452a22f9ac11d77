"""Trays that are predicted in one pass, by a twin that allows for supply and air: each gets what it would get alone.

Matrices of more columns may be multiplied in another order, so numbers may differ by rounding.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np

from fantwin.pipeline.prediction.twin_file import TwinFile
from fantwin.pipeline.runtime.stage import Joint, load_stage
from fantwin.pipeline.runtime.steps import step_together
from fantwin.schemas.blocks import cut
from fantwin.schemas.messages import Grid, Message
from tests.support.integrated_twins import NAN, core_of, grid_of, stairs
from tests.support.twin_files import small_hybrid, write_twin

FANS, TRAYS, SAMPLES, BLOCK = 8, 4, 1200, 25
CONDITIONS = {"supply_voltage_v": 12.0, "temperature_c": 20.0}


class Counting:
    """A stage's way to process blocks; remembers how many trays were in each pass."""

    def __init__(self, joint: Joint) -> None:
        self._joint = joint
        self.trays: list[int] = []

    def process(self, cores: Sequence[Any], blocks: Sequence[Any]) -> Sequence[Any]:
        self.trays.append(len(cores))
        return self._joint.process(cores, blocks)


def grids_of(number: int) -> list[Grid]:
    """Tacho 0 of the first tray drops out and tacho 1 fails; the second loses samples, and the third is silent."""
    rng = np.random.default_rng(number)
    speed = rng.normal(100.0, 3.0, (SAMPLES, FANS))
    if number == 0:
        speed[300:600, 0] = np.where(rng.random(300) < 0.6, NAN, 100.0)
        speed[200:700, 1] = NAN
    whole = replace(
        grid_of(stairs(SAMPLES, FANS, number), speed),
        supply_voltage_v=(12.0 + 0.02 * rng.normal(size=(SAMPLES, FANS)).cumsum(axis=0)).astype(np.float32),
        temperature_c=np.full((SAMPLES, FANS), 21.0, np.float32),
    )
    blocks = [cut(whole, first, first + BLOCK - 5 * (number == 1)) for first in range(0, SAMPLES, BLOCK)]
    return [block for k, block in enumerate(blocks) if number != 2 or not 16 <= k < 28]


def assert_alike(one: Any, other: Any, where: str) -> None:
    if isinstance(one, np.ndarray) and one.dtype.kind == "f":
        rounding = 1e-9 if one.dtype == np.float64 else 1e-6
        np.testing.assert_allclose(other, one, rounding, 1e-9, err_msg=where)
    elif isinstance(one, np.ndarray):
        np.testing.assert_array_equal(other, one, where)
    else:
        assert one == other, where


def test_trays_in_one_pass_are_predicted_as_each_alone(tmp_path: Path) -> None:
    twin = TwinFile.load(write_twin(tmp_path / "twin.onnx", small_hybrid(), conditions=CONDITIONS), FANS)
    grids, cores = [grids_of(number) for number in range(TRAYS)], [core_of(twin, 1.0) for _ in range(TRAYS)]
    made: list[list[Message]] = [[] for _ in grids]
    joint_of = load_stage("twin_integrator").joint
    assert joint_of
    joint = Counting(joint_of())
    for turn in zip_longest(*grids):
        present = [number for number, grid in enumerate(turn) if grid is not None]
        of_turn = step_together(joint, [cores[number] for number in present], [turn[number] for number in present])
        for number, messages in zip(present, of_turn, strict=True):
            made[number] += messages
    assert sum(count for count in joint.trays if count > 1) / sum(joint.trays) > 0.5, "most in one pass with others"
    for number, grids_of_one in enumerate(grids):
        core = core_of(twin, 1.0)
        alone = [message for grid in grids_of_one for message in core.step(grid)]
        for place, (one, other) in enumerate(zip(alone, made[number], strict=True)):
            assert type(one) is type(other)
            for name, values in vars(one).items():
                assert_alike(values, getattr(other, name), f"message {place} of tray {number}: {name}")
        assert core.counters() == cores[number].counters()
