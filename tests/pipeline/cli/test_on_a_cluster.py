"""Commands on real Dask workers on this host."""

from __future__ import annotations

import json
import os
import signal
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

from fantwin.pipeline.cli.in_parallel import RecordingsInParallel
from fantwin.pipeline.errors import UserError
from tests.pipeline.cli.test_many_recordings import RECORDINGS, folder, is_as_of_one_process, run_all
from tests.support.fantwin_command import error_of

pytestmark = pytest.mark.skipif(not find_spec("distributed"), reason="the extra `remote` is not installed")

__all__ = ["folder"]


def cluster_of(workers: int) -> Any:
    distributed: Any = import_module("distributed")  # slow, and only these tests need it
    return distributed.LocalCluster(n_workers=workers, threads_per_worker=1, host="127.0.0.1", dashboard_address=None)


def test_two_workers_give_what_one_process_gives(folder: Path, tmp_path: Path) -> None:
    with cluster_of(2) as cluster:
        scheduler = "--jobs", cluster.scheduler_address
        result = run_all("replay", folder, RECORDINGS, tmp_path / "there", *scheduler)
        assert is_as_of_one_process(result, tmp_path / "there", folder)
        bad = folder / "bad.mcap"
        assert error_of("report", bad, folder / "a.mcap", *scheduler) == error_of("report", bad, "--jobs", 1)
        result = run_all("report", folder, ("a.mcap", "bad.mcap"), tmp_path / "skipped", *scheduler, "--skip-bad")
        (skipped,) = json.loads(result.stdout)["skipped"]
        assert (result.exit_code, skipped["recording"]) == (4, str(bad))


def end_itself(_path: Path) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def test_a_worker_that_is_killed_is_an_error_of_one_line(folder: Path) -> None:
    dask: Any = import_module("dask")
    import_module("distributed")  # with its own settings: the end of `set` would take them away if it had made them
    paths = [folder / name for name in RECORDINGS]
    with (
        dask.config.set({"distributed.scheduler.allowed-failures": 0}),
        cluster_of(1) as cluster,
        RecordingsInParallel(jobs=cluster.scheduler_address) as pool,
        pytest.raises(UserError, match=f"ended from outside, .*: see {cluster.scheduler_address}"),
    ):
        list(pool.map(end_itself, paths, "reading"))


def test_no_scheduler_there_is_one_line(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fantwin.pipeline.cli.in_parallel.CONNECT_S", 0.2)
    error = error_of("report", folder / "a.mcap", "--jobs", "tcp://127.0.0.1:1")
    assert error == "--jobs tcp://127.0.0.1:1: no Dask scheduler answers there"
