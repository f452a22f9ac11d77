"""A tray of 1,024 fans, whose samples come from a table: through acquisition, grid, twin and scorer."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fantwin.pipeline.acquisition.sample_blocks import ReadingBlock
from fantwin.pipeline.config.loading import parse_config
from fantwin.pipeline.config.settings import Config
from fantwin.pipeline.errors import UserError
from fantwin.pipeline.prediction.twin_file import TwinFile
from fantwin.pipeline.runtime.stage import Context, Core, load_stage
from fantwin.pipeline.sources.serial.config import MOST_FANS_ON_LINE
from fantwin.pipeline.sources.source import MOST_FANS, LinkUp, Reading, ReadingBatch
from fantwin.schemas import wire
from fantwin.schemas.codec import decode, encode
from fantwin.schemas.enums import Transition
from fantwin.schemas.header import Header
from fantwin.schemas.messages import Alarm, Grid, Message, Prediction, Raw, Score
from fantwin.schemas.topics import BY_NAME, TOPICS, most_samples
from fantwin.schemas.units import NS_PER_S
from fantwin.twin.models.physical import PhysicalModel
from tests.support.twin_files import write_twin

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
