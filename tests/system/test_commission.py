"""`fantwin commission` on a simulated tray: from a line to a calibrated twin in the configuration."""

from __future__ import annotations

import json
import re
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from pipeline.cli.watch import commission
from pipeline.config.loading import load_config
from pipeline.learning import ordinary_operation
from pipeline.recordings.reading import read_recording
from pipeline.runtime.tray_twin import load_tray_twin
from scoring.limits import Limits
from tests.support.fantwin_command import error_of, fantwin
from tests.support.running_chain import RunningCommand, eventually

pytestmark = [pytest.mark.slow, pytest.mark.real_time]
FANS = 2


@pytest.fixture
def configuration(tmp_path: Path, endpoint: str) -> Path:
    path = tmp_path / "fantwin.toml"
    path.write_text(
        f'run_folder = "runs"\n[bus]\nendpoint = "{endpoint}"\n[[tray]]  # of the laboratory\nname = "tray1"\n'
        f'fans = {FANS}\nspeed_unit = "rpm"\nport = "{tmp_path / "line"}"\n[viewer]\nserve = false\n',
        encoding="utf-8",
    )
    return path


@pytest.fixture
def tray(tmp_path: Path) -> Iterator[RunningCommand]:
    words = (
        "simulate",
        "--fans",
        FANS,
        "--speed-unit",
        "rpm",
        "--link",
        tmp_path / "line",
        "--profile",
        "prbs",
        "--json",
    )
    tray = RunningCommand(words)
    try:
        tray.line_with("fans on")
        yield tray
    finally:
        tray.kill()


@pytest.mark.timeout(400)
def test_a_tray_that_its_plant_moves_gets_a_calibrated_twin(
    configuration: Path, tray: RunningCommand, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(commission, "stop_on_signals", lambda _stop: None)  # this process has its own
    for name, least in (("NEEDED_RANGES", 2), ("NEEDED_S", 3.0), ("NEEDED_CHANGES", 2)):
        monkeypatch.setattr(ordinary_operation, name, least)
    before = configuration.read_text(encoding="utf-8")
    result = fantwin("commission", "-c", configuration, "--minutes", 0.6, "--json")
    assert not result.exception, result.exception
    found = json.loads(result.stdout)
    after = configuration.read_text(encoding="utf-8")
    assert after == before.replace("# of the laboratory\n", '# of the laboratory\ntwin = "tray1.onnx"\n')
    twin = load_tray_twin(configuration.with_name("tray1.onnx"), FANS)
    declared = Limits.model_validate(twin.card.calibration).declared_rate
    assert declared
    assert declared.extrapolated
    assert found["extrapolated"]
    assert found["false_alarms_per_day"] == 1.0
    assert load_config(configuration).trays[0].twin == Path("tray1.onnx")
    assert [Path(name).name for name in found["recordings"]] == [
        "recording.mcap",
        "recording-2.mcap",
        "recording-3.mcap",
    ]
    assert twin.card.training.data[0].name == "recording.mcap"


def test_beside_a_running_site_it_is_refused_and_what_is_killed_leaves_no_recorder_behind(
    configuration: Path, tray: RunningCommand
) -> None:
    run = RunningCommand(["commission", "-c", configuration, "--json"])
    try:
        run.line_with("recording ordinary operation for 10 min")
        assert "site 'site' runs already" in error_of("commission", "-c", configuration)
        run.end(signal.SIGKILL)
        finished = configuration.parent / "runs" / "recording.mcap"
        eventually(finished.exists, "the recorder ends in order")
    finally:
        run.kill()


def test_ctrl_c_leaves_the_recording_and_no_twin(configuration: Path, tray: RunningCommand) -> None:
    before = configuration.read_text(encoding="utf-8")
    run = RunningCommand(["commission", "-c", configuration, "--json"])
    try:
        run.line_with("recording ordinary operation for 10 min")
        assert run.end() == 130
        line = run.line_with("interrupted: no twin was written; recorded until then:")
    finally:
        run.kill()
    (recording,) = configuration.parent.glob("runs/recording*")
    assert re.search(r"runs/recording\.mcap$", line)
    assert any(True for _ in read_recording(recording, topics=("raw",)))
    assert configuration.read_text(encoding="utf-8") == before
    assert not list(configuration.parent.glob("*.onnx"))
