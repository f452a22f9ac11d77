"""A new channel needs its row in `schemas/channels.py` and its field in `fan.proto`, and nothing else.

The toy, the vibration of a fan, is added to a copy of these two files; all other code is the product's.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[2]
CHANNEL = "vibration_rms_mm_s"
ROW = f'    {CHANNEL}: Array = channel("vibration rms", "mm/s", "A", 0.0, 1000.0)\n'
FIELD = f"  repeated float {CHANNEL} = 4;\n"
TOPICS = ("raw", "grid", "prediction", "score")


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """A folder from which `fantwin` is imported with the toy's row and field."""
    protoc = pytest.importorskip("grpc_tools.protoc", reason="grpcio-tools of the extra `dev` is not installed")
    pytest.importorskip("rerun")
    folder = tmp_path / "package"
    folder.mkdir()
    shutil.copytree(ROOT / "fantwin", folder / "fantwin", symlinks=True)
    shutil.copytree(ROOT / "schemas", folder / "schemas")
    for name in ("pipeline", "scoring", "simulation", "stages", "tests", "twin"):
        (folder / name).symlink_to(ROOT / name)
    _insert(folder / "schemas" / "channels.py", "    temperature_c: Array = ", ROW)
    _insert(folder / "schemas" / "fan.proto", "  repeated float temperature_c = ", FIELD)
    assert protoc.main(["protoc", f"-I{folder}", f"--python_out={folder}", "schemas/fan.proto"]) == 0
    return folder


def _insert(path: Path, after: str, line: str) -> None:
    text = path.read_text(encoding="utf-8")
    end = text.index("\n", text.index(after)) + 1
    path.write_text(text[:end] + line + text[end:], encoding="utf-8")


def test_a_channel_goes_from_a_payload_to_every_output_by_its_row_and_its_field(package: Path, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "tests.support.vibrating_fan", str(tmp_path), CHANNEL]
    environment = os.environ | {"PYTHONPATH": str(package)}
    run = subprocess.run(command, cwd=package, env=environment, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    found = json.loads(run.stdout.splitlines()[-1])
    assert found["line"], "a line of 64 fans with all channels is too long"
    sent = np.arange(200) / 200
    for topic in TOPICS:
        values = found[f"recording, {topic}"]
        assert 150 <= len(values) <= 200, topic
        assert np.all(np.diff(values) >= 0.0) and values[-1] == pytest.approx(sent[-1], abs=0.03), topic
    assert found["recording, raw"] == pytest.approx(sent)
    assert found["export"] == pytest.approx(sent)
    newest = found["recording, score"][-1]
    assert len(found["page"]) >= 6 and np.isin(np.round(found["page"], 3), np.round(found["recording, score"], 3)).all()
    assert {"name": CHANNEL, "title": "vibration rms", "unit": "mm/s"} in found["page, words"]
    assert found["metrics"] == [pytest.approx(newest, abs=1e-4)]
    assert found["Rerun"] == pytest.approx(found["recording, score"])
