"""Measured machines through the whole chain: imported, a twin of their first part, the rest played down the line."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from pipeline.recordings.reading import read_recording
from schemas.messages import ModelCard, Raw, Score
from tests.support.running_chain import Running, fantwin

ESC = ("esc_test/f40_steps_5-2.csv", ["--time", "Timestamp", "--command", "Duty", "--speed", "RPM:rpm"])
ROSA = (
    "rosa/healthy_103.csv",
    ["--time", "Time:ms", "--command", "Shaft Control Effort", "--speed", "Actual Speed:rpm"],
)
CONFIG = """
site = "bench"
run_folder = "{folder}"
[bus]
endpoint = "{endpoint}"
[[tray]]
name = "rig"
fans = 1
port = "{folder}/line"
speed_unit = "rpm"
speed_max = 30000
command_max = 100
twin = "{folder}/twin.onnx"
[viewer]
serve = false
"""


@contextmanager
def ended(running: Running) -> Iterator[Running]:
    try:
        yield running
    finally:
        running.kill()


def trained_on_the_first_part(measured_data: Path, folder: Path, name: str, columns: list[str], until_s: float) -> None:
    done = fantwin("import", measured_data / name, *columns, "-o", folder / "all.mcap")
    assert done.returncode == 0, done.stderr
    words = ["--model", "physical", "--to", until_s, "-o", folder / "twin.onnx"]
    done = fantwin("train", folder / "all.mcap", *words, timeout_s=200)
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
@pytest.mark.data
@pytest.mark.real_time
@pytest.mark.parametrize(
    ("data", "first_part_s", "played_s"), [(ESC, 80, (94, 115)), (ROSA, 30, (30, 48))], ids=["esc_test", "rosa"]
)
def test_the_rest_of_a_measured_file_comes_through_whole_and_its_residual_is_sane(
    measured_data, tmp_path, endpoint, data, first_part_s, played_s
):
    name, columns = data
    trained_on_the_first_part(measured_data, tmp_path, name, columns, first_part_s)
    config = tmp_path / "rig.toml"
    config.write_text(CONFIG.format(folder=tmp_path, endpoint=endpoint))
    part = ["--from", played_s[0], "--to", played_s[1]]
    line = ["--link", tmp_path / "line", "--speed-unit", "rpm", "--wait-for-reader", "--truth", tmp_path / "truth.json"]
    with (
        ended(Running(["simulate", "--from-csv", measured_data / name, *columns, *part, *line, "--json"])) as tray,
        ended(Running(["up", "-c", config, "--json"])) as up,
    ):
        assert tray.process.wait(120) == 0
        status = up.end()
        outcome = up.output()
        assert status == 0, (outcome, up.lines)
    assert not any(outcome["lost"].values())
    assert outcome["restarts"] == {}

    entries = [entry.message for entry in read_recording(tmp_path / "recording.mcap", topics=("raw", "score", "twin"))]
    raws = [message for message in entries if isinstance(message, Raw)]
    scores = [message for message in entries if isinstance(message, Score)]
    truth = json.loads((tmp_path / "truth.json").read_text())
    assert sum(len(raw.host_receive_t_ns) for raw in raws) == truth["samples_sent"] > 0
    valid, command, measured, residual = (
        np.concatenate([getattr(score, column) for score in scores])
        for column in ("valid", "command", "measured_speed_rad_s", "residual_rad_s")
    )
    card = next(json.loads(message.card_json) for message in entries if isinstance(message, ModelCard))
    low, high = card["command_range"]
    beyond = (command < low - 0.05 * (high - low)) | (command > high + 0.05 * (high - low))
    assert not valid[beyond].any(), "a twin is not believed beyond the commands it was made from"
    assert valid.mean() > 0.25
    assert np.isfinite(residual[valid]).all()
    assert np.sqrt(np.mean(residual[valid] ** 2)) < 0.1 * np.nanmax(measured)
