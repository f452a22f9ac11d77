"""`fantwin commission` on a simulated tray: from a line to a calibrated twin in the configuration."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from fantwin.pipeline.cli.watch import commission
from fantwin.pipeline.cli.watch.commissioning import Commissioning
from fantwin.pipeline.config.loading import load_config
from fantwin.pipeline.learning import ordinary_operation
from fantwin.pipeline.prediction.tray_twin import load_tray_twin
from fantwin.scoring.calibration.calibration import Calibration
from tests.support.fantwin_command import error_of, fantwin
from tests.support.running_chain import RunningCommand

pytestmark = [pytest.mark.slow, pytest.mark.real_time]
FANS = 1
MINUTES = 0.2


@pytest.fixture
def configuration(tmp_path: Path, endpoint: str) -> Path:
    path = tmp_path / "fantwin.toml"
    path.write_text(
        f'run_folder = "runs"\n[bus]\nendpoint = "{endpoint}"\n[[tray]]  # of the laboratory\nname = "tray1"\n'
        f'fans = {FANS}\nspeed_unit = "rpm"\nport = "{tmp_path / "line"}"\n[viewer]\ngrpc_port = 0\n',
        encoding="utf-8",
    )
    return path


def test_a_tray_that_its_plant_moves_gets_a_calibrated_twin_and_meanwhile_a_second_one_is_refused(
    tmp_path: Path,
    configuration: Path,
    start_command: Callable[..., RunningCommand],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The plant of the simulated tray moves its fans and hardly ever lets them stand."""
    line = ("--set", "rate_hz=20", "--set", "speed_unit=rpm", "--link", tmp_path / "line", "--json")
    start_command("simulate", "--fans", FANS, "--profile", "multisine", *line).line_with(" on ")
    monkeypatch.setattr(commission, "stop_on_signals", threading.Event)  # this process has its own
    for name, least in (("NEEDED_RANGES", 2), ("NEEDED_S", 3.0), ("NEEDED_CHANGES", 2)):
        monkeypatch.setattr(ordinary_operation, name, least)
    before, operate, refused = configuration.read_text(encoding="utf-8"), Commissioning._operate, ""

    def beside_another(*words: Any) -> None:
        nonlocal refused
        refused = refused or error_of("commission", "-c", configuration)
        operate(*words)

    monkeypatch.setattr(Commissioning, "_operate", beside_another)
    result = fantwin("commission", "-c", configuration, "--minutes", MINUTES, "--json")
    assert not result.exception, result.exception
    assert refused.startswith("site 'site' runs already (")
    found = json.loads(result.stdout)
    after = before.replace("# of the laboratory\n", '# of the laboratory\ntwin = "tray1.onnx"\n')
    assert configuration.read_text(encoding="utf-8") == after
    assert [tray.twin for tray in load_config(configuration).trays] == [Path("tray1.onnx")]
    (its,) = found["trays"]
    twin = load_tray_twin(configuration.with_name(its["entry"]), FANS)
    assert Calibration.model_validate(twin.card.calibration).is_target
    assert its["is_target"]
    assert its["false_alarms_per_day"] == 1.0
    assert 0.5 < its["fan_hours"] / (FANS * 2 * MINUTES / 60) < 3.0
    assert twin.card.training.data[0].name == "commissioned-1.mcap"
    assert twin.card.fans == FANS
    recordings = [configuration.parent / f"runs/commissioned-{n}/commissioned-{n}.mcap" for n in (1, 2, 3)]
    assert found["recordings"] == list(map(str, recordings))
    assert all(path.exists() for path in recordings)
