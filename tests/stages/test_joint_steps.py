"""Trays that are predicted in one pass, by a twin that allows for supply and air: each gets what it would get alone.

Matrices of more columns may be multiplied in another order, so numbers may differ by rounding.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fantwin.pipeline.config.loading import parse_config
from fantwin.pipeline.runtime.building import build_parts
from fantwin.pipeline.runtime.stage import Context, Core, Joint, load_stage
from fantwin.pipeline.runtime.steps import step_together
from fantwin.schemas.header import Header
from fantwin.schemas.messages import Message, Raw
from fantwin.schemas.units import NS_PER_S
from fantwin.simulation.faults import Fault
from fantwin.simulation.plant import Surroundings
from fantwin.simulation.tray import SimulatedTray, TraySettings
from tests.support.twin_files import small_hybrid, write_twin

EPOCH_NS, SECONDS, BLOCK = 1_700_000_000 * NS_PER_S, 12.0, 25
CONDITIONS = {"supply_voltage_v": 12.0, "temperature_c": 20.0}
FAULTS: tuple[tuple[Fault, ...], ...] = (
    (Fault("tacho-dropout", 0, 3.0, 6.0, 0.6), Fault("tacho-dropout", 1, 2.0, 7.0, 1.0)),
    (),
    (),
    (),
)
"""faults of each tray; the second loses samples, and the third is silent for 3 s"""
LOSING, SILENT = 1, 2


class Counting:
    """A stage's way to process blocks; remembers how many trays were in each pass."""

    def __init__(self, joint: Joint) -> None:
        self._joint = joint
        self.trays: list[int] = []

    def process(self, cores: Sequence[Any], blocks: Sequence[Any]) -> Sequence[Any]:
        self.trays.append(len(cores))
        return self._joint.process(cores, blocks)


@pytest.fixture
def twin(tmp_path: Path) -> Path:
    return write_twin(tmp_path / "twin.onnx", small_hybrid(), conditions=CONDITIONS)


def cores_of(stage: str, twin: Path) -> list[Core]:
    table = '[[tray]]\nname = "tray{}"\nfans = 8\ntwin = "' + str(twin) + '"\n'
    text = "[resampler]\nrate_hz = 100\n" + "".join(map(table.format, range(len(FAULTS))))
    config = parse_config(text, Path("/nowhere/fantwin.toml"), (), ("resampler", "twin_integrator", "scorer"))
    context = Context(
        site=config.site,
        trays=config.trays,
        config=config.sections[stage],
        folder=config.folder,
        run_folder=config.run_folder,
        started_t_ns=EPOCH_NS,
    )
    return [parts.core for parts in build_parts(load_stage(stage), context).values()]


def raws(number: int) -> Iterator[Raw]:
    settings = TraySettings(
        seed=number + 1,
        duration_s=SECONDS,
        faults=FAULTS[number],
        lost=0.02 if number == LOSING else 0.0,
        surroundings=Surroundings(supply_wander=0.02, measured=("supply_voltage_v", "temperature_c")),
    )
    tray, samples = SimulatedTray(settings), []
    while tray.due_s() is not None:
        samples.append(tray.take())
    for sequence, first in enumerate(range(0, len(samples), BLOCK)):
        block = samples[first : first + BLOCK]
        if number == SILENT and 4.0 <= block[0].t_s < 7.0:
            continue
        yield Raw(
            header=Header("source", sequence, f"tray{number}"),
            fans=8,
            host_receive_t_ns=np.array([EPOCH_NS + round(each.t_s * NS_PER_S) for each in block]),
            device_clock_us=np.array([each.clock_us for each in block], np.uint32),
            device_sequence=np.array([each.sequence for each in block], np.uint32),
            command=np.array([100.0 * each.command for each in block]),
            speed_rad_s=np.array([each.speed_rad_s for each in block]),
            supply_voltage_v=np.array([each.auxiliary["supply_voltage_v"] for each in block], np.float32),
            temperature_c=np.array([each.auxiliary["temperature_c"] for each in block], np.float32),
        )


def together(cores: Sequence[Core], items: Sequence[Sequence[Message]]) -> tuple[list[list[Message]], list[int]]:
    """What the cores make of their messages in turns of one of each tray; and the number of trays in each pass."""
    made: list[list[Message]] = [[] for _ in items]
    joint_of = load_stage("twin_integrator").joint
    assert joint_of
    joint = Counting(joint_of())
    for turn in zip_longest(*items):
        present = [number for number, item in enumerate(turn) if item is not None]
        of_turn = step_together(joint, [cores[number] for number in present], [turn[number] for number in present])
        for number, messages in zip(present, of_turn, strict=True):
            made[number] += messages
    return made, joint.trays


def assert_alike(one: Any, other: Any, where: str) -> None:
    if isinstance(one, np.ndarray) and one.dtype.kind == "f":
        rounding = 1e-9 if one.dtype == np.float64 else 1e-6
        np.testing.assert_allclose(other, one, rounding, 1e-9, err_msg=where)
    elif isinstance(one, np.ndarray):
        np.testing.assert_array_equal(other, one, where)
    else:
        assert one == other, where


def test_trays_in_one_pass_are_predicted_as_each_alone(twin: Path) -> None:
    resamplers, joint_cores = cores_of("resampler", twin), cores_of("twin_integrator", twin)
    grids = [[grid for raw in raws(k) for grid in resampler.step(raw)] for k, resampler in enumerate(resamplers)]
    joint_messages, trays = together(joint_cores, grids)
    assert sum(count for count in trays if count > 1) / sum(trays) > 0.5, "of the blocks, most in one pass with others"
    for number, core in enumerate(cores_of("twin_integrator", twin)):
        alone = [made for grid in grids[number] for made in core.step(grid)]
        assert len(alone) == len(joint_messages[number])
        for place, (one, other) in enumerate(zip(alone, joint_messages[number], strict=True)):
            assert type(one) is type(other)
            for name, values in vars(one).items():
                assert_alike(values, getattr(other, name), f"message {place} of tray {number}: {name}")
        assert core.counters() == joint_cores[number].counters()
