"""Measured machines through the whole chain: a twin trained on the first part, the rest played on a serial line.

Two rigs are two trays of one site and run at the same time.
"""

from __future__ import annotations

import json
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from fantwin.pipeline.recordings.reading import read_recording
from fantwin.schemas.enums import InvalidReason
from fantwin.schemas.messages import Message, ModelCard, Prediction, Raw, Score
from tests.support.fantwin_command import fantwin
from tests.support.running_chain import DEADLINE_S, RunningCommand

pytestmark = [pytest.mark.slow, pytest.mark.data, pytest.mark.real_time]


@dataclass(frozen=True)
class Rig:
    """A measured file: its columns, how much of it trains the twin, and the stretch that is played, s."""

    tray: str
    file: str
    time: str
    command: str
    speed: str
    first_part_s: float
    played_s: tuple[float, float]


RIGS = (
    Rig(
        tray="esc_test",
        file="esc_test/f40_steps_5-2.csv",
        time="Timestamp",
        command="Duty",
        speed="RPM:rpm",
        first_part_s=80,
        played_s=(94, 115),
    ),
    Rig(
        tray="rosa",
        file="rosa/healthy_103.csv",
        time="Time:ms",
        command="Shaft Control Effort",
        speed="Actual Speed:rpm",
        first_part_s=30,
        played_s=(30, 48),
    ),
)
SITE = """
site = "bench"
run_folder = "{folder}"
[bus]
endpoint = "{endpoint}"
[resampler]
watermark_s = 5  # a host that runs other tests may stall for more than the default, and late samples would be lost
[recorder]
topics = ["raw", "prediction", "score"]
[launcher]
stages = ["acquisition", "resampler", "twin_integrator", "scorer", "recorder"]
"""
TRAY = """
[[tray]]
name = "{tray}"
fans = 1
port = "{folder}/{tray}.line"
speed_unit = "rpm"
speed_max = 30000
command_max = 100
twin = "{folder}/{tray}.onnx"
"""


def train_on_the_first_part(rig: Rig, measured_data: Path, folder: Path) -> None:
    recording, twin = folder / f"{rig.tray}-all.mcap", folder / f"{rig.tray}.onnx"
    columns = ("--time", rig.time, "--command", rig.command, "--speed", rig.speed)
    done = fantwin("import", measured_data / rig.file, *columns, "-o", recording)
    assert done.exit_code == 0, done.exception
    done = fantwin("train", recording, "--model", "physical", "--to", rig.first_part_s, "-o", twin)
    assert done.exit_code == 0, done.exception


def play(rig: Rig, measured_data: Path, folder: Path) -> RunningCommand:
    """The rest of the file, as if the rig measured it live."""
    begin_s, end_s = rig.played_s
    line = ("--link", folder / f"{rig.tray}.line", "--set", "speed_unit=rpm", "--wait-for-reader")
    truth = ("--truth", folder / f"{rig.tray}.json", "--json")
    columns = f'time = "{rig.time}"\ncommand = ["{rig.command}"]\nspeed = ["{rig.speed}"]\n'
    scenario = folder / f"{rig.tray}.played.toml"
    part = f'path = "{measured_data / rig.file}"\nfrom_s = {begin_s}\nto_s = {end_s}\n'
    scenario.write_text(f"[file]\n{part}{columns}", encoding="utf-8")
    return RunningCommand(["simulate", scenario, *line, *truth])


def check(rig: Rig, folder: Path, messages: list[Message]) -> None:
    """All samples sent are there, the twin is believed only where it was trained, and its residual is small."""
    raws = [message for message in messages if isinstance(message, Raw)]
    predictions = [message for message in messages if isinstance(message, Prediction)]
    scores = [message for message in messages if isinstance(message, Score)]
    truth = json.loads((folder / f"{rig.tray}.json").read_text())
    assert truth["bytes_unread"] == 0
    assert sum(len(raw.host_receive_t_ns) for raw in raws) == truth["samples_sent"] > 0
    valid, invalid_reason, command, measured, predicted = (
        np.concatenate([getattr(prediction, column) for prediction in predictions])
        for column in ("valid", "invalid_reason", "command", "measured_speed_rad_s", "predicted_speed_rad_s")
    )
    residual = measured - predicted
    judged = np.concatenate([score.valid for score in scores])
    card = next(json.loads(message.card_json) for message in messages if isinstance(message, ModelCard))
    low, high = card["command_range"]
    beyond = (command < low - 0.05 * (high - low)) | (command > high + 0.05 * (high - low))
    assert not valid[beyond].any(), "a twin is not valid beyond its training commands"
    stands = invalid_reason == InvalidReason.STOPPED
    assert (valid | stands).mean() > 0.25
    assert judged[valid].all() and not judged[stands].any()
    assert np.isfinite(residual[valid]).all()
    assert np.sqrt(np.mean(residual[valid] ** 2)) < 0.1 * np.nanmax(measured)


def test_the_rest_of_measured_files_comes_through_whole_and_the_residuals_are_small(measured_data, tmp_path, endpoint):
    for rig in RIGS:
        train_on_the_first_part(rig, measured_data, tmp_path)
    config = tmp_path / "rigs.toml"
    trays = "".join(TRAY.format(tray=rig.tray, folder=tmp_path) for rig in RIGS)
    config.write_text(SITE.format(folder=tmp_path, endpoint=endpoint) + trays)
    with ExitStack() as ends:
        played = [play(rig, measured_data, tmp_path) for rig in RIGS]
        up = RunningCommand(["up", "-c", config, "--json"])
        for running in (*played, up):
            ends.callback(running.kill)
        for running in played:
            assert running.process.wait(2 * DEADLINE_S) == 0
        status = up.end()
        outcome = up.output()
    assert status == 0, "\n".join((str(outcome), *up.lines))
    assert not any(outcome["lost"].values())
    assert outcome["restarts"] == {}
    entries = list(read_recording(tmp_path / "recording.mcap", topics=("raw", "prediction", "score", "alarm", "twin")))
    for rig in RIGS:
        check(rig, tmp_path, [entry.message for entry in entries if entry.message.header.tray == rig.tray])
