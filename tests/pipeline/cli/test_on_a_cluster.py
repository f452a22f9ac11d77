"""Commands on real Dask workers on this host."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.pipeline.cli.test_many_recordings import RECORDINGS, folder, outcome_of, run_all
from tests.support.fantwin_command import error_of

distributed = pytest.importorskip("distributed", reason="the extra `cluster` is not installed")

__all__ = ["folder"]


def test_two_workers_give_what_one_process_gives(folder: Path, tmp_path: Path) -> None:
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, host="127.0.0.1", dashboard_address=None
    ) as cluster:
        scheduler = "--scheduler", cluster.scheduler_address
        for command in ("identify", "calibrate", "replay"):
            alone, there = tmp_path / f"{command}-alone", tmp_path / command
            expected = outcome_of(run_all(command, folder, RECORDINGS, alone, "--jobs", 1), alone)
            result = run_all(command, folder, RECORDINGS, there, *scheduler)
            assert result.exit_code == 0, result.output
            assert outcome_of(result, there) == expected
        bad = folder / "bad.mcap"
        assert error_of("identify", bad, folder / "a.mcap", *scheduler) == error_of("identify", bad, "--jobs", 1)
        result = run_all("identify", folder, ("a.mcap", "bad.mcap"), tmp_path / "skipped", *scheduler, "--skip-bad")
        assert (result.exit_code, len(json.loads(result.stdout)["skipped"])) == (4, 1)


def test_no_scheduler_there_is_one_line(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pipeline.cli.recordings_in_parallel.CONNECT_S", 0.2)
    error = error_of("identify", folder / "a.mcap", "--scheduler", "tcp://127.0.0.1:1")
    assert error == "--scheduler tcp://127.0.0.1:1: no Dask scheduler answers there"
