"""Recordings at URLs: in memory, and in an S3 store on this host."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from fantwin.pipeline.recordings.reading import RecordingError, read_metadata
from fantwin.pipeline.recordings.remote import RemotePath, local_copies, matching, recording_path
from tests.support.fan_data import published_run
from tests.support.fantwin_command import error_of, fantwin
from tests.support.written_recordings import sequences, write, write_run

fsspec = pytest.importorskip("fsspec", reason="the extra `remote` is not installed")


@pytest.fixture
def at_url(tmp_path: Path) -> Iterator[str]:
    """The folder of a recording in fsspec's memory."""
    memory = fsspec.filesystem("memory")
    memory.pipe_file("/site/day.mcap", write(tmp_path / "day.mcap", 20).read_bytes())
    yield "memory://site"
    memory.store.clear()


def test_a_recording_at_a_url_reads_as_a_file_does_and_is_named_by_its_url(at_url: str) -> None:
    path = recording_path(f"{at_url}/day.mcap")
    assert (str(path), path.name) == (f"{at_url}/day.mcap", "day.mcap")
    with local_copies():
        assert sequences(path) == list(range(20))
        assert read_metadata(path).metadata["site"] == "plant"
    with local_copies(), pytest.raises(RecordingError) as raised:
        sequences(recording_path(f"{at_url}/night.mcap"))
    assert str(raised.value) == f"{at_url}/night.mcap: cannot read the recording: there is no such file"


def test_it_is_fetched_once_while_it_is_worked_on(at_url: str) -> None:
    path = recording_path(f"{at_url}/day.mcap")
    with local_copies():
        assert sequences(path) == list(range(20))
        fsspec.filesystem("memory").rm("/site/day.mcap")
        assert sequences(path) == list(range(20))
    with local_copies(), pytest.raises(RecordingError, match="there is no such file"):
        sequences(path)


def test_wildcards_stand_for_what_is_there_in_order(at_url: str, tmp_path: Path) -> None:
    for name in ("b", "a"):
        fsspec.filesystem("memory").pipe_file(f"/site/{name}.mcap", b"")
    given = [tmp_path / "*.mcap", RemotePath(f"{at_url}/*.mcap")]
    found = [str(tmp_path / "*.mcap"), *(f"{at_url}/{name}.mcap" for name in ("a", "b", "day"))]
    assert [str(path) for path in matching(given)] == found
    with pytest.raises(RecordingError, match="no file matches"):
        matching([RemotePath(f"{at_url}/none-*.mcap")])


@pytest.fixture
def store(monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """The address of an S3 server on this host."""
    pytest.importorskip("s3fs", reason="the extra `remote` is not installed")
    moto = pytest.importorskip("moto.server", reason="moto is not installed")
    server = moto.ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    for key, value in {
        "AWS_ENDPOINT_URL": f"http://{host}:{port}",
        "AWS_ACCESS_KEY_ID": "testing",
        "AWS_SECRET_ACCESS_KEY": "testing",
        "AWS_DEFAULT_REGION": "us-east-1",
    }.items():
        monkeypatch.setenv(key, value)
    yield "s3://fleet"
    server.stop()


def test_a_command_works_on_recordings_in_s3_as_on_files(store: str, tmp_path: Path) -> None:
    pipes = fsspec.filesystem("s3", endpoint_url=os.environ["AWS_ENDPOINT_URL"])
    pipes.mkdir("fleet")
    names = ("a.mcap", "b.mcap")
    for seed, name in enumerate(names, start=1):
        write_run(tmp_path / name, published_run(seed, 10.0))
        pipes.put(str(tmp_path / name), f"fleet/{name}")
    of_files = fantwin("report", *(tmp_path / name for name in names), "--json", "--jobs", 1)
    in_store = fantwin("report", f"{store}/*.mcap", "--json", "--jobs", 1)
    assert (in_store.exit_code, in_store.stdout) == (0, of_files.stdout), in_store.output
    error = error_of("report", f"{store}/a.mcap", f"{store}/c.mcap", "--jobs", 1)
    assert error == f"{store}/c.mcap: cannot read the recording: there is no such file"
