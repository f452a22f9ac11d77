"""Trays that are predicted in one pass: each gets what it would get alone.

Decisions of their scorers are the same. Matrices of more columns may be multiplied in another order, so numbers may
differ by rounding.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fantwin.pipeline.config.loading import parse_config
from fantwin.pipeline.replay.offline.tolerance import differences
from fantwin.pipeline.runtime.building import build_parts
from fantwin.pipeline.runtime.joint_step import step_together
from fantwin.pipeline.runtime.stage import Context, Core, Joint, load_stage
from fantwin.schemas.header import Header
from fantwin.schemas.messages import Alarm, Grid, Message, Prediction, Raw
from fantwin.schemas.units import NS_PER_S
from fantwin.simulation.faults import Fault
from fantwin.simulation.tray import SimulatedTray, TraySettings

EPOCH_NS, SECONDS, BLOCK = 1_700_000_000 * NS_PER_S, 30.0, 25
TWIN = Path(__file__).parents[2] / "pipeline" / "demo" / "twin.onnx"
FAULTS: tuple[tuple[Fault, ...], ...] = (
    (Fault("rotor", 3, 13.0, 19.0, 1.0),),
    (Fault("tacho-dropout", 0, 11.0, 19.0, 0.6), Fault("inlet", 5, 14.0, 20.0, 1.6)),
    (Fault("tacho-stuck", 7, 12.0, 18.0), Fault("tacho-dropout", 1, 3.0, 9.3, 1.0)),
    (Fault("supply", 2, 14.0, 20.0, 0.85),),
    (),
)
"""faults of each tray; the fourth loses samples, and the last one is silent for 3 s"""
LOSING, SILENT = 3, 4


class Counting:
    """A stage's way to process blocks; remembers how many trays were in each pass."""

    def __init__(self, joint: Joint) -> None:
        self._joint = joint
        self.trays: list[int] = []

    def process(self, cores: Sequence[Any], blocks: Sequence[Any]) -> Sequence[Any]:
        self.trays.append(len(cores))
        return self._joint.process(cores, blocks)


@pytest.fixture(scope="module")
def grids() -> list[list[Grid]]:
    """Samples of each tray."""
    cores = cores_of("resampler")
    return [
        [grid for raw in raws(number) for grid in core.step(raw) if isinstance(grid, Grid)]
        for number, core in enumerate(cores)
    ]


def cores_of(stage: str) -> list[Core]:
    table = '[[tray]]\nname = "tray{}"\nfans = 8\ntwin = "' + str(TWIN) + '"\n'
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
        seed=number + 1, duration_s=SECONDS, faults=FAULTS[number], lost=0.02 if number == LOSING else 0.0
    )
    tray, samples = SimulatedTray(settings), []
    while tray.due_s() is not None:
        samples.append(tray.take())
    for sequence, first in enumerate(range(0, len(samples), BLOCK)):
        block = samples[first : first + BLOCK]
        if number == SILENT and 15.0 <= block[0].t_s < 18.0:
            continue
        yield Raw(
            header=Header("source", sequence, f"tray{number}"),
            fans=8,
            host_receive_t_ns=np.array([EPOCH_NS + round(each.t_s * NS_PER_S) for each in block]),
            device_clock_us=np.array([each.clock_us for each in block], np.uint32),
            device_sequence=np.array([each.sequence for each in block], np.uint32),
            command=np.array([each.command for each in block]),
            speed_rad_s=np.array([each.speed_rad_s for each in block]),
        )


def alone(stage: str, items: Sequence[Sequence[Message]]) -> tuple[list[Core], list[list[Message]]]:
    """What the core of each tray makes of its messages."""
    cores = cores_of(stage)
    return cores, [
        [made for item in of_tray for made in core.step(item)] for core, of_tray in zip(cores, items, strict=True)
    ]


def together(stage: str, items: Sequence[Sequence[Message]]) -> tuple[list[Core], list[list[Message]], list[int]]:
    """The same in turns of one message of each tray; and the number of trays in each pass."""
    cores, made = cores_of(stage), [[] for _ in items]
    joint_of = load_stage(stage).joint
    assert joint_of
    joint = Counting(joint_of())
    for turn in zip_longest(*items):
        present = [number for number, item in enumerate(turn) if item is not None]
        of_turn = step_together(joint, [cores[number] for number in present], [turn[number] for number in present])
        for number, messages in zip(present, of_turn, strict=True):
            made[number] += messages
    return cores, made, joint.trays


def share_of_joint(trays: Sequence[int]) -> float:
    """Of the blocks, those that were processed with others."""
    return sum(count for count in trays if count > 1) / sum(trays)


def assert_equal(expected: list[list[Message]], found: list[list[Message]]) -> None:
    for number, (of_alone, of_joint) in enumerate(zip(expected, found, strict=True)):
        assert len(of_alone) == len(of_joint), number
        for place, (one, other) in enumerate(zip(of_alone, of_joint, strict=True)):
            where = f"message {place} of tray {number}, a {type(one).__name__}"
            assert type(one) is type(other) and one.header == other.header, where
            for name, values in vars(one).items():
                assert_alike(values, getattr(other, name), f"{where}: {name}")


def assert_alike(one: Any, other: Any, where: str) -> None:
    if isinstance(one, np.ndarray) and one.dtype.kind == "f":
        rounding = 1e-9 if one.dtype == np.float64 else 1e-6
        np.testing.assert_allclose(other, one, rounding, 1e-9, err_msg=where)
    elif isinstance(one, np.ndarray):
        np.testing.assert_array_equal(other, one, where)
    elif where.endswith("state_json"):
        assert not list(differences(json.loads(one), json.loads(other), lambda _: None)), where
    else:
        assert not list(differences({where: one}, {where: other}, lambda _: None)), where


def test_trays_in_one_pass_are_predicted_as_each_alone_and_scored_alike(grids: list[list[Grid]]) -> None:
    of_integrators, messages = alone("twin_integrator", grids)
    joint_integrators, joint_messages, trays = together("twin_integrator", grids)
    assert_equal(messages, joint_messages)
    assert [core.counters() for core in of_integrators] == [core.counters() for core in joint_integrators]
    assert share_of_joint(trays) > 0.7

    scorers, scored = alone("scorer", predictions_of(messages))
    joint_scorers, joint_scored = alone("scorer", predictions_of(joint_messages))
    assert_equal(scored, joint_scored)
    assert [core.counters() for core in scorers] == [core.counters() for core in joint_scorers]
    assert len({each.fan for of_tray in scored for each in of_tray if isinstance(each, Alarm)}) >= 4
    for one, other in zip(scorers, joint_scorers, strict=True):
        assert_equal([list(one.close())], [list(other.close())])


def predictions_of(messages: list[list[Message]]) -> list[list[Message]]:
    """Samples of each tray."""
    return [[each for each in of_tray if isinstance(each, Prediction)] for of_tray in messages]
