"""A tray of 1,024 fans, whose samples come from a table: through acquisition, grid, twin and scorer."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
import pytest

from pipeline.config.loading import parse_config
from pipeline.config.models import Config, ConfigError
from pipeline.devices.measured_table import Table, read_table
from pipeline.devices.sample_source import (
    MOST_FANS,
    LinkUp,
    Reading,
    ReadingBatch,
    SourceConfig,
    SourceContext,
    SourceEvent,
)
from pipeline.devices.serial_config import MOST_FANS_ON_LINE
from pipeline.devices.source_kinds import SOURCE_KINDS, SourceKind
from pipeline.devices.table_device import TableDevice
from pipeline.errors import UserError
from pipeline.runtime.stage import Context, Core, load_stage
from pipeline.runtime.twin_file import TwinFile
from schemas import wire
from schemas.codec import decode, encode
from schemas.enums import Transition
from schemas.header import Header
from schemas.messages import Alarm, Grid, Message, Prediction, Raw, Score
from schemas.topics import BY_NAME, TOPICS, most_samples
from schemas.units import NS_PER_S
from tests.support.twin_files import small_hybrid, write_twin

FANS, FAULTY, SAMPLES, RATE_HZ = 1024, 1000, 800, 100
CHAIN = ("acquisition", "resampler", "twin_integrator", "scorer")
CONFIGURATION = f"""
[[tray]]
name = "hall"
fans = {FANS}
command_max = 100.0
twin = "twin.onnx"
source = {{ kind = "table", path = "hall.csv" }}
[acquisition]
block_s = 1.0
[resampler]
rate_hz = {RATE_HZ}
[twin_integrator]
warm_up_s = 0.5
[scorer]
baseline_s = 0.2
alarm_sigmas = 5.0
on_delay_s = 0.1
"""
TOPIC_OF = {topic.message: topic.name for topic in TOPICS}


class TableConfig(SourceConfig, frozen=True):
    """`source = { kind = "table", path = ... }`."""

    kind: Literal["table"] = "table"
    path: Path


class TableSource:
    """Delivers the rows of a table, each at its own time."""

    name = "table"
    settings_to_check = "path"

    def __init__(self, config: TableConfig, context: SourceContext) -> None:
        self._table = table_of(context.folder / config.path, context.fans)

    def start(self, deliver: Callable[[SourceEvent], None]) -> None:
        device = TableDevice(self._table, 0.0, np.inf)
        deliver(LinkUp())
        while device.due_s() is not None:
            row = device.take()
            reading = Reading(tuple(row.command.tolist()), tuple(row.speed_rad_s.tolist()), sequence=row.sequence)
            deliver(ReadingBatch(round((1.0 + row.t_s) * NS_PER_S), (reading,)))

    def stop(self) -> None:
        pass

    def send(self, command: tuple[float, ...], set_point: tuple[float, ...]) -> str:
        return "not connected"

    def check(self) -> list[str]:
        return []


@pytest.fixture(autouse=True)
def _table_row(monkeypatch: pytest.MonkeyPatch) -> None:
    kind = SourceKind(f"{__name__}:TableConfig", f"{__name__}:TableSource")
    monkeypatch.setitem(SOURCE_KINDS, "table", kind)


@pytest.fixture(scope="module")
def hall(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a twin of one fan, and the table of a hall of such fans, one of which becomes slow."""
    folder = tmp_path_factory.mktemp("hall")
    write_twin(folder / "twin.onnx", small_hybrid(), fans=1)
    twin = TwinFile.load(folder / "twin.onnx", FANS)
    rng = np.random.default_rng(1)
    times_s = np.arange(SAMPLES) / RATE_HZ
    command = np.repeat(50.0 + 30.0 * np.sin(times_s)[:, np.newaxis], FANS, axis=1)
    state = twin.initial_state(np.full(FANS, 100.0), command[0])
    speed, _ = twin.advance(state, command, np.full(SAMPLES, 1.0 / RATE_HZ))
    speed = speed + rng.normal(0.0, 3.0, speed.shape)
    speed[SAMPLES // 2 :, FAULTY] -= 60.0
    names = ",".join(f"s{fan}" for fan in range(FANS))
    columns = np.column_stack((times_s, command[:, 0], speed))
    np.savetxt(folder / "hall.csv", columns, "%.3f", ",", header=f"t,u,{names}", comments="")
    return folder


def table_of(path: Path, fans: int) -> Table:
    return read_table(path, "t:s", ["u"], [f"s{fan}" for fan in range(fans)])


def config_of(folder: Path, text: str = CONFIGURATION) -> Config:
    return parse_config(text, folder / "site.toml", (), CHAIN)


def context_of(config: Config, stage: str) -> Context:
    return Context("hall", config.trays, config.sections[stage], config.folder, config.folder, started_t_ns=0)


def test_all_fans_of_a_large_tray_are_judged_and_its_messages_stay_within_their_limits(hall):
    config = config_of(hall)
    parts = {stage: load_stage(stage).build(context_of(config, stage)) for stage in CHAIN}
    cores = [parts[stage].core for stage in CHAIN]
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

    source = parts["acquisition"].source
    assert source
    source.start(lambda event: pass_on(list(cores[0].step(event)), cores[1:]))
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


def test_a_tray_has_at_most_the_fans_that_its_source_carries():
    assert wire.MAX_FANS == MOST_FANS_ON_LINE < FANS == MOST_FANS
    (tray,) = config_of(Path(), CONFIGURATION).trays
    assert tray.fans == FANS
    with pytest.raises(ConfigError, match=r"tray.0.fans = 1025: input should be less than or equal to 1024"):
        config_of(Path(), CONFIGURATION.replace(str(FANS), "1025"))
    line = CONFIGURATION.replace('{ kind = "table", path = "hall.csv" }', '{ kind = "serial", port = "/dev/ttyUSB0" }')
    refused = "fans = 1024: a serial source carries at most 64 fans; make several trays of them"
    with pytest.raises(ConfigError) as caught:
        config_of(Path(), line)
    assert str(caught.value) == f"site.toml: tray.0: {refused}"
    without_port = config_of(Path(), line.replace(', port = "/dev/ttyUSB0"', ""))
    assert without_port.trays[0].fans == FANS, "its samples come from elsewhere, such as a replay"
    with pytest.raises(UserError, match=refused):
        load_stage("acquisition").build(context_of(without_port, "acquisition"))
