"""Commands over many recordings: the same from one process, several and a cluster; bad recordings, and the end."""

from __future__ import annotations

import json
import os
import select
import signal
import subprocess
import sys
import threading
from collections.abc import Sequence
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
from threadpoolctl import threadpool_info, threadpool_limits
from typer.testing import Result

from fantwin.pipeline.cli.in_parallel import RecordingsInParallel
from fantwin.pipeline.errors import UserError
from fantwin.pipeline.learning.training_data import Part, read_recording_data
from fantwin.twin.evaluation.resampling import thinned
from fantwin.twin.export.onnx_twin import OnnxTwin
from tests.support.but_for_times import but_for_times, content_of
from tests.support.fan_data import published_run
from tests.support.fantwin_command import error_of, fantwin
from tests.support.made_once import MadeOnce
from tests.support.running_chain import DEADLINE_S
from tests.support.written_recordings import write_run

RECORDINGS = ("a.mcap", "b.mcap", "c.mcap")
BAD = "bad.mcap"
needs_distributed = pytest.mark.skipif(not find_spec("distributed"), reason="the extra `remote` is not installed")


@pytest.fixture(scope="module")
def folder(made_once: MadeOnce) -> Path:
    """Three recordings of a healthy tray, a file that is none, a twin, and what one process makes of them."""

    def make(path: Path) -> None:
        for seed, name in enumerate(RECORDINGS, start=1):
            write_run(path / name, thinned(published_run(seed, 6.0 + 2.0 * seed, fans=2), 5))
        (path / BAD).write_bytes(b"nothing that was recorded")
        trained = fantwin("train", path / "a.mcap", "--model", "physical", "-o", path / "twin.onnx")
        assert trained.exit_code == 0, trained.output
        alone = run_all("replay", path, RECORDINGS, path / "alone", "--jobs", 1)
        assert alone.exit_code == 0, alone.output
        (path / "alone.json").write_text(alone.stdout)

    return made_once("many-recordings", make)


def words_of(command: str, folder: Path, recordings: Sequence[Path | str], output: Path) -> list[Any]:
    """The words of a command, which writes into the folder `output` if it writes anything."""
    words: dict[str, Sequence[object]] = {
        "report": recordings,
        "train": (*recordings, "--model", "physical", "-o", output / "trained.onnx"),
        "replay": ("--offline", *recordings, "--twin", folder / "twin.onnx", "-o", output),
    }
    return [command, *words[command], "--json"]


def outcome_of(printed: str, output: Path) -> tuple[str, dict[str, bytes]]:
    """What a command printed and what it wrote, but for times and the folder of its output."""
    said = json.dumps(but_for_times(json.loads(printed))).replace(str(output), "OUTPUT")
    return said, {path.name: content_of(path).replace(str(output).encode(), b"OUTPUT") for path in output.iterdir()}


def is_as_of_one_process(result: Result, output: Path, folder: Path) -> bool:
    """Whether a replay of the three recordings has printed and written what one process does."""
    assert result.exit_code == 0, result.output
    return outcome_of(result.stdout, output) == outcome_of((folder / "alone.json").read_text(), folder / "alone")


def run_all(command: str, folder: Path, names: tuple[str, ...], output: Path, *options: object) -> Result:
    output.mkdir()
    return fantwin(*words_of(command, folder, [folder / name for name in names], output), *options)


def test_two_processes_print_and_write_what_one_does(folder: Path, tmp_path: Path) -> None:
    result = run_all("replay", folder, RECORDINGS, tmp_path / "two", "--jobs", 2)
    assert is_as_of_one_process(result, tmp_path / "two", folder)


def test_networks_that_are_trained_two_at_a_time_give_the_same_twin(folder: Path, tmp_path: Path) -> None:
    outcomes = []
    for jobs in (1, 2):
        output = tmp_path / f"with-{jobs}"
        output.mkdir()
        options = ("--networks", 2, "--iterations", 2, "--to", 6, "--json", "--jobs", jobs)
        result = fantwin("train", folder / RECORDINGS[0], *options, "-o", output / "trained.onnx")
        assert result.exit_code == 0, result.output
        assert ("training, 2 networks at a time" in result.stderr) == (jobs == 2)
        assert OnnxTwin(output / "trained.onnx").card.training.networks == 2
        outcomes.append(outcome_of(result.stdout, output))
    assert outcomes[0] == outcomes[1]


def test_a_bad_recording_stops_all_before_anything_is_written_or_is_skipped_and_named(
    folder: Path, tmp_path: Path
) -> None:
    names = (*RECORDINGS[:1], BAD, *RECORDINGS[1:2])
    output = tmp_path / "stopped"
    output.mkdir()
    error = error_of(*words_of("train", folder, [folder / name for name in names], output), "--jobs", 1)
    assert error == f"{folder / BAD}: not a recording (MCAP); make one from a table with `fantwin import`"
    assert list(output.iterdir()) == []

    skipping, without = tmp_path / "skipping", tmp_path / "without"
    result = run_all("train", folder, names, skipping, "--jobs", 1, "--skip-bad")
    assert result.exit_code == 4, result.output
    assert result.stderr.splitlines()[-1] == f"skipped: {error}"
    document = json.loads(result.stdout)
    assert document.pop("skipped") == [{"recording": str(folder / BAD), "reason": error}]
    good = run_all("train", folder, RECORDINGS[:2], without, "--jobs", 1)
    assert outcome_of(json.dumps(document), skipping) == outcome_of(good.stdout, without)


def test_the_error_of_another_process_is_that_of_one_and_of_several_the_first_argument_s(folder: Path) -> None:
    bad = [folder / "none.mcap", folder / BAD]
    expected = f"{folder / 'none.mcap'}: cannot read the recording: No such file or directory"
    assert error_of("report", folder / "a.mcap", *bad, "--jobs", 2) == expected


def test_a_recording_of_which_nothing_can_be_scored_is_bad_and_leaves_no_output(folder: Path, tmp_path: Path) -> None:
    short = write_run(tmp_path / "short.mcap", published_run(9, 0.05, fans=2))
    words = ("replay", "--offline", folder / "a.mcap", short, "--twin", folder / "twin.onnx", "-o", tmp_path / "out")
    result = fantwin(*words, "--jobs", 1, "--skip-bad", "--json")
    assert result.exit_code == 4, result.output
    (skipped,) = json.loads(result.stdout)["skipped"]
    assert skipped["recording"] == str(short) and "no sample could be scored" in skipped["reason"]
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["a.mcap"]


def test_a_recording_that_was_skipped_stays_so_in_all_that_follows(folder: Path) -> None:
    paths = [folder / name for name in (BAD, "a.mcap")]
    pool = RecordingsInParallel(jobs=1, skip_bad=True)
    assert len(list(pool.map(lambda path: read_recording_data(path, Part()), paths, "reading"))) == 1
    seen: list[Path] = []
    list(pool.map(seen.append, paths, "again"))
    assert seen == [folder / "a.mcap"]


def end_itself(_path: Path) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


@pytest.mark.parametrize("jobs", [1, 2])
def test_in_every_process_linear_algebra_has_one_thread_and_torch_is_not_loaded_and_one_that_is_killed_is_one_line(
    folder: Path, jobs: int
) -> None:
    """More threads would round in another order, so results would depend on the number of cores."""

    def found(path: Path) -> tuple[set[int], bool]:
        read_recording_data(path, Part())
        return {each["num_threads"] for each in threadpool_info()}, jobs > 1 and "torch" in sys.modules

    paths = [folder / name for name in RECORDINGS[:2]]
    with threadpool_limits(2), RecordingsInParallel(jobs) as pool:
        assert list(pool.map(found, paths, "counting")) == [({1}, False)] * 2
        if jobs > 1:
            with pytest.raises(UserError, match="ended from outside, .* fewer --jobs than 2"):
                list(pool.map(end_itself, paths, "reading"))


def test_ctrl_c_ends_all_processes_with_one_line(tmp_path: Path) -> None:
    """Both workers wait in the middle of their recording, which is a pipe, when the terminal sends Ctrl-C to all."""
    pipes = [tmp_path / name for name in ("one.mcap", "two.mcap")]
    for pipe in pipes:
        os.mkfifo(pipe)
    command = subprocess.Popen(
        [sys.executable, "-m", "fantwin", "report", *map(str, pipes), "--jobs", "2"],
        stderr=subprocess.PIPE, text=True, start_new_session=True,
    )  # fmt: skip
    ends = [os.open(pipe, os.O_WRONLY) for pipe in pipes]  # returns when a worker has opened it
    os.killpg(command.pid, signal.SIGINT)
    _, errors = command.communicate(timeout=DEADLINE_S)
    assert (command.returncode, errors) == (130, "interrupted: nothing was identified\n")
    closed = select.poll()
    for end in ends:
        closed.register(end, 0)
        assert closed.poll(1000 * DEADLINE_S), "the worker that read it has not ended"
        closed.unregister(end)
        os.close(end)


def test_a_command_that_is_ended_while_it_fetches_a_recording_leaves_no_copy(tmp_path: Path) -> None:
    pytest.importorskip("s3fs", reason="the extra `remote` is not installed")
    begun, ended = threading.Semaphore(0), threading.Event()

    class Endless(BaseHTTPRequestHandler):
        """Sends the beginning of a file, and no more."""

        def do_HEAD(self) -> None:
            self.send_response(200)
            self.send_header("Content-Length", "1000000")
            self.send_header("Accept-Ranges", "none")
            self.end_headers()

        def do_GET(self) -> None:
            self.do_HEAD()
            self.wfile.write(bytes(1000))
            self.wfile.flush()
            begun.release()
            ended.wait()

        def log_message(self, format: str, *args: object) -> None:
            """Nothing."""

    temporary = tmp_path / "temporary"
    temporary.mkdir()
    with ThreadingHTTPServer(("127.0.0.1", 0), Endless) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        urls = [f"http://127.0.0.1:{server.server_port}/{name}" for name in RECORDINGS[:2]]
        command = subprocess.Popen(
            [sys.executable, "-m", "fantwin", "report", *urls, "--jobs", "2"],
            stderr=subprocess.PIPE, text=True, env=os.environ | {"TMPDIR": str(temporary)},
        )  # fmt: skip
        assert begun.acquire(timeout=DEADLINE_S) and begun.acquire(timeout=DEADLINE_S)
        assert len([*temporary.glob("fantwin-copies-*/fantwin-copies-*")]) == 2
        command.terminate()
        _, errors = command.communicate(timeout=DEADLINE_S)
        ended.set()
        server.shutdown()
    assert (command.returncode, errors) == (130, "interrupted: nothing was identified\n")
    assert [*temporary.iterdir()] == []


@needs_distributed
def test_two_workers_of_a_cluster_give_what_one_process_gives_and_one_that_is_killed_is_one_line(
    folder: Path, tmp_path: Path
) -> None:
    dask: Any = import_module("dask")
    distributed: Any = import_module("distributed")  # slow, and only these tests need it; with settings of its own
    with (
        dask.config.set({"distributed.scheduler.allowed-failures": 0}),
        distributed.LocalCluster(2, threads_per_worker=1, host="127.0.0.1", dashboard_address=None) as cluster,
    ):
        scheduler = "--jobs", cluster.scheduler_address
        result = run_all("replay", folder, RECORDINGS, tmp_path / "there", *scheduler)
        assert is_as_of_one_process(result, tmp_path / "there", folder)
        bad = folder / "bad.mcap"
        assert error_of("report", bad, folder / "a.mcap", *scheduler) == error_of("report", bad, "--jobs", 1)
        result = run_all("report", folder, ("a.mcap", "bad.mcap"), tmp_path / "skipped", *scheduler, "--skip-bad")
        (skipped,) = json.loads(result.stdout)["skipped"]
        assert (result.exit_code, skipped["recording"]) == (4, str(bad))
        paths = [folder / name for name in RECORDINGS]
        with (
            RecordingsInParallel(jobs=cluster.scheduler_address) as pool,
            pytest.raises(UserError, match=f"ended from outside, .*: see {cluster.scheduler_address}"),
        ):
            list(pool.map(end_itself, paths, "reading"))


@needs_distributed
def test_no_scheduler_there_is_one_line(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fantwin.pipeline.cli.in_parallel.CONNECT_S", 0.2)
    error = error_of("report", folder / "a.mcap", "--jobs", "tcp://127.0.0.1:1")
    assert error == "--jobs tcp://127.0.0.1:1: no Dask scheduler answers there"
