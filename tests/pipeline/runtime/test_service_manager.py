"""What a process says to whoever started it."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from fantwin.pipeline.runtime.service_manager import FILE_VARIABLE, PERIOD_S, VARIABLE, SignsOfLife


@pytest.fixture
def file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.delenv(VARIABLE, raising=False)
    monkeypatch.setenv(FILE_VARIABLE, str(tmp_path / "alive"))
    return tmp_path / "alive"


def test_the_file_is_renewed_when_the_main_loop_runs_and_only_then(file, monkeypatch):
    now_s = [100.0]
    monkeypatch.setattr("fantwin.pipeline.runtime.service_manager.time.monotonic", lambda: now_s[0])
    notifier = SignsOfLife.from_environment()
    notifier.ready()
    assert not file.exists()
    notifier.at_work("ok")
    os.utime(file, (0, 0))
    notifier.at_work("degraded: the disk is full")
    assert file.stat().st_mtime == 0, "not at every turn"
    now_s[0] += PERIOD_S
    notifier.at_work("degraded: the disk is full")
    assert file.stat().st_mtime > 0, "a stage with a problem is still at work"


def test_a_file_that_cannot_be_renewed_ends_nothing(file):
    file.mkdir()
    file.rmdir()
    file.parent.rmdir()
    SignsOfLife.from_environment().at_work("ok")
