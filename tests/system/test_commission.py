"""`fantwin commission` on a simulated tray: from a line to a calibrated twin in the configuration."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from fantwin.pipeline.cli.watch import commission
from fantwin.pipeline.config.loading import load_config
from fantwin.pipeline.learning import ordinary_operation
from fantwin.pipeline.prediction.tray_twin import load_tray_twin
from fantwin.pipeline.recordings.reading import read_recording
from fantwin.scoring.calibration.calibration import Calibration
from tests.support.fantwin_command import error_of, fantwin
from tests.support.running_chain import RunningCommand

pytestmark = [pytest.mark.slow, pytest.mark.real_time]
FANS = 1
MINUTES = 0.3


@pytest.fixture
def configuration(tmp_path: Path, endpoint: str) -> Path:
    path = tmp_path / "fantwin.toml"
    path.write_text(
        f'run_folder = "runs"\n[bus]\nendpoint = "{endpoint}"\n[[tray]]  # of the laboratory\nname = "tray1"\n'
        f'fans = {FANS}\nspeed_unit = "rpm"\nport = "{tmp_path / "line"}"\n[viewer]\ngrpc_port = 0\n',
        encoding="utf-8",
    )
    return path


@pytest.fixture
def tray(tmp_path: Path) -> Iterator[RunningCommand]:
    """A simulated one, whose plant moves its fans and hardly ever lets them stand."""
    line = ("--set", "rate_hz=20", "--set", "speed_unit=rpm", "--link", tmp_path / "line", "--json")
    tray = RunningCommand(("simulate", "--fans", FANS, "--profile", "multisine", *line))
    try:
        tray.line_with(" on ")
        yield tray
    finally:
        tray.kill()


def test_a_tray_that_its_plant_moves_gets_a_calibrated_twin(
    configuration: Path, tray: RunningCommand, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(commission, "stop_on_signals", lambda _stop: None)  # this process has its own
    for name, least in (("NEEDED_RANGES", 2), ("NEEDED_S", 3.0), ("NEEDED_CHANGES", 2)):
        monkeypatch.setattr(ordinary_operation, name, least)
    before = configuration.read_text(encoding="utf-8")
    result = fantwin("commission", "-c", configuration, "--minutes", MINUTES, "--json")
    assert not result.exception, result.exception
    found = json.loads(result.stdout)
    after = before.replace("# of the laboratory\n", '# of the laboratory\ntwin = "tray1.onnx"\n')
    assert configuration.read_text(encoding="utf-8") == after
    assert [tray.twin for tray in load_config(configuration).trays] == [Path("tray1.onnx")]
    (its,) = found["trays"]
    twin = load_tray_twin(configuration.with_name(its["entry"]), FANS)
    assert Calibration.model_validate(twin.card.calibration).is_target
    assert its["is_target"]
    assert its["false_alarms_per_day"] == 1.0
    assert its["fan_hours"] == pytest.approx(FANS * 2 * MINUTES / 60, rel=0.5)
    assert twin.card.training.data[0].name == "commissioned-1.mcap"
    assert twin.card.fans == FANS
    recordings = [configuration.parent / f"runs/commissioned-{n}/commissioned-{n}.mcap" for n in (1, 2, 3)]
    assert found["recordings"] == list(map(str, recordings))
    assert all(path.exists() for path in recordings)


def test_a_second_one_is_refused_and_ctrl_c_leaves_no_twin(configuration: Path, tray: RunningCommand) -> None:
    before = configuration.read_text(encoding="utf-8")
    run = RunningCommand(["commission", "-c", configuration, "--json"])
    try:
        run.line_with("recording ordinary operation for 10 min")
        assert "site 'site' runs already" in error_of("commission", "-c", configuration)
        assert run.end() == 130
        line = run.line_with("interrupted: no twin was written; recorded until then:")
    finally:
        run.kill()
    (recording,) = configuration.parent.glob("runs/commissioned-1/*")
    assert re.search(r"runs/commissioned-1/commissioned-1\.mcap$", line)
    assert any(True for _ in read_recording(recording, topics=("raw",)))
    assert configuration.read_text(encoding="utf-8") == before
    assert not list(configuration.parent.glob("*.onnx"))
