"""A tray of 1,024 fans, from a table through acquisition, grid, twin and scorer; and trays in one pass."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fantwin.pipeline.acquisition.sample_blocks import ReadingBlock
from fantwin.pipeline.config.loading import parse_config
from fantwin.pipeline.config.settings import Config
from fantwin.pipeline.errors import UserError
from fantwin.pipeline.prediction.twin_file import TwinFile
from fantwin.pipeline.runtime.stage import Context, Core, Joint, load_stage
from fantwin.pipeline.runtime.steps import step_together
from fantwin.pipeline.sources.serial.config import MOST_FANS_ON_LINE
from fantwin.pipeline.sources.source import MOST_FANS, LinkUp, Reading, ReadingBatch
from fantwin.schemas import wire
from fantwin.schemas.blocks import cut
from fantwin.schemas.codec import decode, encode
from fantwin.schemas.enums import Transition
from fantwin.schemas.header import Header
from fantwin.schemas.messages import Alarm, Grid, Message, Prediction, Raw, Score
from fantwin.schemas.topics import BY_NAME, TOPICS, most_samples
from fantwin.schemas.units import NS_PER_S
from fantwin.twin.models.physical import PhysicalModel
from tests.support.integrated_twins import NAN, core_of, grid_of, stairs
from tests.support.twin_files import small_hybrid, write_twin

FANS, FAULTY, SAMPLES, RATE_HZ = 1024, 1000, 350, 100
CHAIN = ("acquisition", "resampler", "twin_integrator", "scorer")
CONFIGURATION = f"""
[[tray]]
name = "hall"
fans = {FANS}
command_max = 100.0
twin = "twin.onnx"
source = {{ kind = "push" }}
[acquisition]
block_s = 1.0
[resampler]
rate_hz = {RATE_HZ}
[twin_integrator]
warm_up_s = 0.5
"""
TOPIC_OF = {topic.message: topic.name for topic in TOPICS}


@pytest.fixture(scope="module")
def hall(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[ReadingBatch]]:
    """A folder with a twin of one fan, and the readings of a hall of such fans, one of which becomes slow."""
    folder = tmp_path_factory.mktemp("hall")
    write_twin(folder / "twin.onnx", PhysicalModel(), fans=1)
    twin = TwinFile.load(folder / "twin.onnx", FANS)
    rng = np.random.default_rng(1)
    times_s = np.arange(SAMPLES) / RATE_HZ
    command = np.repeat(50.0 + 30.0 * np.sin(times_s)[:, np.newaxis], FANS, axis=1)
    state = twin.initial_state(np.full(FANS, 100.0), command[0])
    speed, _ = twin.advance(state, command, np.full(SAMPLES, 1.0 / RATE_HZ))
    speed = speed + rng.normal(0.0, 3.0, speed.shape)
    speed[SAMPLES // 2 :, FAULTY] -= 60.0
    rows = zip(times_s.tolist(), command.tolist(), speed.tolist(), strict=True)
    batches = [
        ReadingBatch(round((1.0 + t_s) * NS_PER_S), (Reading(tuple(given), tuple(read), sequence=number),))
        for number, (t_s, given, read) in enumerate(rows)
    ]
    return folder, batches


def config_of(folder: Path, text: str = CONFIGURATION) -> Config:
    return parse_config(text, folder / "site.toml", (), CHAIN)


def context_of(config: Config, stage: str) -> Context:
    return Context("hall", config.trays, config.sections[stage], config.folder, config.folder, started_t_ns=0)


def test_all_fans_of_a_large_tray_are_judged_and_its_messages_stay_within_their_limits(hall):
    folder, batches = hall
    config = config_of(folder)
    cores = [load_stage(stage).build(context_of(config, stage)).core for stage in CHAIN]
    found: list[Message] = []

    def pass_on(made: list[Message], later: list[Core]) -> None:
        for message in made:
            topic = BY_NAME[TOPIC_OF[type(message)]]
            payload = encode(replace(message, header=Header(topic.name, len(found), "hall")))
            assert len(payload) <= topic.largest_bytes / 2
            arrived = decode(topic.message, payload)
            found.append(arrived)
            if isinstance(arrived, Raw | Grid | Prediction):
                pass_on(list(later[0].step(arrived)), later[1:])

    pass_on(list(cores[0].step(LinkUp())), cores[1:])
    for first in range(0, SAMPLES, 300):
        pass_on(list(cores[0].step(ReadingBlock(tuple(batches[first : first + 300])))), cores[1:])
    for number, core in enumerate(cores):
        pass_on(list(core.close()), cores[number + 1 :])
    raws = [message for message in found if isinstance(message, Raw)]
    assert sum(len(raw.host_receive_t_ns) for raw in raws) == SAMPLES
    assert max(len(raw.host_receive_t_ns) for raw in raws) <= most_samples(FANS) == 256
    scores = [message for message in found if isinstance(message, Score)]
    judged = np.concatenate([score.valid for score in scores])
    assert judged.shape[1] == FANS and judged[200:].all()
    raised = [alarm for alarm in found if isinstance(alarm, Alarm) and alarm.transition == Transition.RAISED]
    assert [alarm.fan for alarm in raised] == [FAULTY]


def test_a_serial_line_of_more_fans_than_it_carries_may_be_replayed_and_its_acquisition_is_refused():
    assert wire.MAX_FANS == MOST_FANS_ON_LINE < FANS == MOST_FANS
    without_port = config_of(Path(), CONFIGURATION.replace('"push"', '"serial"'))
    assert without_port.trays[0].fans == FANS, "its samples come from elsewhere"
    with pytest.raises(UserError, match="fans = 1024: a serial source carries at most 64 fans; make several trays"):
        load_stage("acquisition").build(context_of(without_port, "acquisition"))


SOME_FANS, TRAYS, OF_EACH, BLOCK = 8, 4, 1200, 25
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
    speed = rng.normal(100.0, 3.0, (OF_EACH, SOME_FANS))
    if number == 0:
        speed[300:600, 0] = np.where(rng.random(300) < 0.6, NAN, 100.0)
        speed[200:700, 1] = NAN
    whole = replace(
        grid_of(stairs(OF_EACH, SOME_FANS, number), speed),
        supply_voltage_v=(12.0 + 0.02 * rng.normal(size=(OF_EACH, SOME_FANS)).cumsum(axis=0)).astype(np.float32),
        temperature_c=np.full((OF_EACH, SOME_FANS), 21.0, np.float32),
    )
    blocks = [cut(whole, first, first + BLOCK - 5 * (number == 1)) for first in range(0, OF_EACH, BLOCK)]
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
    twin = TwinFile.load(write_twin(tmp_path / "twin.onnx", small_hybrid(), conditions=CONDITIONS), SOME_FANS)
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
