"""`fantwin commission` on a simulated tray: from a line to a calibrated twin in the configuration."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from pipeline.cli.watch import commission
from pipeline.config.loading import load_config
from pipeline.learning import ordinary_operation
from pipeline.recordings.reading import read_recording
from pipeline.runtime.tray_twin import load_tray_twin
from scoring.limits import Limits
from tests.support.fantwin_command import error_of, fantwin
from tests.support.running_chain import RunningCommand

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


@contextmanager
def playing(link: Path, fans: int) -> Iterator[RunningCommand]:
    """A simulated tray, whose plant moves its fans."""
    words = (
        *("simulate", "--fans", fans, "--rate", 20, "--speed-unit", "rpm"),
        *("--link", link, "--profile", "prbs", "--json"),
    )
    tray = RunningCommand(words)
    try:
        tray.line_with(" on ")
        yield tray
    finally:
        tray.kill()


@pytest.fixture
def tray(tmp_path: Path) -> Iterator[RunningCommand]:
    with playing(tmp_path / "line", FANS) as tray:
        yield tray


def test_trays_that_their_plant_moves_get_calibrated_twins(
    configuration: Path, tray: RunningCommand, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(commission, "stop_on_signals", lambda _stop: None)  # this process has its own
    for name, least in (("NEEDED_RANGES", 2), ("NEEDED_S", 3.0), ("NEEDED_CHANGES", 2)):
        monkeypatch.setattr(ordinary_operation, name, least)
    line = configuration.with_name("other-line")
    other = f'[[tray]]  # other\nname = "b"\nfans = 1\nspeed_unit = "rpm"\nport = "{line}"\n'
    before = configuration.read_text(encoding="utf-8") + other
    configuration.write_text(before, encoding="utf-8")
    with playing(line, 1):
        result = fantwin("commission", "-c", configuration, "--minutes", 0.7, "--json")
    assert not result.exception, result.exception
    found = json.loads(result.stdout)
    after = before.replace("# of the laboratory\n", '# of the laboratory\ntwin = "tray1.onnx"\n')
    after = after.replace("# other\n", '# other\ntwin = "b.onnx"\n')
    assert configuration.read_text(encoding="utf-8") == after
    assert [tray.twin for tray in load_config(configuration).trays] == [Path("tray1.onnx"), Path("b.onnx")]
    for its, fans in zip(found["trays"], (FANS, 1), strict=True):
        twin = load_tray_twin(configuration.with_name(its["entry"]), fans)
        declared = Limits.model_validate(twin.card.calibration).declared_rate
        assert declared
        assert declared.extrapolated
        assert its["extrapolated"]
        assert its["false_alarms_per_day"] == 1.0
        assert its["fan_hours"] == pytest.approx(fans * 2 * 0.7 / 60, rel=0.25)
        assert twin.card.training.data[0].name == "commissioned-1.mcap"
        assert twin.card.fans == fans
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
