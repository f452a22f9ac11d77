"""Other programs delete, move, replace or cut the file that the recorder writes."""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from fantwin.pipeline.recordings.contents import contents_of
from fantwin.pipeline.recordings.reading import read_metadata, read_recording
from fantwin.pipeline.recordings.recorder import Recorder
from fantwin.stages.recorder import STAGE
from tests.support.stub_disk import RAW_KEY, SECOND_NS, context, envelope, raw

START_NS = context(Path()).started_t_ns
STREAM = (RAW_KEY, "acquisition-1")


class Run:
    """A recorder in a folder, which gets ten messages a second."""

    def __init__(self, folder: Path, **config) -> None:
        core = STAGE.build(context(folder, **config)).core
        assert isinstance(core, Recorder)
        self.core, self.folder = core, folder / "runs"
        self.active = self.folder / "recording.mcap.active"
        self._second = 0

    def seconds(self, count: int) -> None:
        for _ in range(count):
            self._second += 1
            now_ns = START_NS + self._second * SECOND_NS
            for sequence in range(10 * (self._second - 1), 10 * self._second):
                self.core.step(envelope(raw(sequence), "raw", now_ns))
            self.core.tick(now_ns)

    def recorded(self) -> list[int]:
        paths = sorted(self.folder.glob("*.mcap"), key=lambda path: path.stat().st_mtime_ns)
        return [found.message.header.sequence for path in paths for found in read_recording(path)]


def delete_the_folder(active: Path) -> None:
    shutil.rmtree(active.parent)


def move_the_folder(active: Path) -> None:
    active.parent.rename(active.parent.with_name("elsewhere"))


@pytest.mark.parametrize("interfere", [Path.unlink, delete_the_folder, move_the_folder])
def test_row_03_a_recording_deleted_while_running_is_reported_and_recorded_again(
    tmp_path, interfere: Callable[[Path], None]
):
    run = Run(tmp_path)
    run.seconds(3)
    interfere(run.active)
    run.seconds(2)
    assert "recording.mcap: another program deleted, moved or replaced the file while it was" in run.core.problem()
    run.core.close()
    assert run.recorded() == list(range(50))
    assert run.core.counters() == {"recorded_raw": 50, "lost_unwritten": 0, "parts": 1, "files_restored": 1}
    assert contents_of(run.folder / "recording.mcap").streams[STREAM].missing == 0
    assert not run.active.exists()


def test_row_03_the_file_that_replaced_a_recording_is_left_alone(tmp_path, monkeypatch):
    monkeypatch.setattr("fantwin.pipeline.recordings.disk_room.PART_S", 5.0)
    run = Run(tmp_path)
    run.seconds(3)
    run.active.unlink()
    run.active.write_bytes(b"of another program")
    run.seconds(6)
    run.core.close()
    assert run.active.read_bytes() == b"of another program"
    assert run.recorded() == list(range(90))
    assert sorted(path.name for path in run.folder.glob("*.mcap")) == ["recording-2.mcap", "recording-3.mcap"]
    assert read_metadata(run.folder / "recording-3.mcap").metadata["continues"] == "recording-2.mcap"


@pytest.mark.parametrize("how", ["deleted", "cut"])
def test_row_03_what_cannot_be_restored_is_lost_and_counted(tmp_path, monkeypatch, how):
    monkeypatch.setattr("fantwin.pipeline.recordings.recorder.LONGEST_FLUSH_S", 1.0)
    run = Run(tmp_path)
    run.seconds(3)

    def refuse(*_: int) -> bytes:
        raise OSError(errno.EIO, "Input/output error")

    if how == "cut":
        os.truncate(run.active, 0)
    else:
        run.active.unlink()
        monkeypatch.setattr(os, "pread", refuse)
    run.seconds(1)
    why = "another program deleted or cut the file while it was written; messages lost with it: 20"
    assert why in run.core.problem()
    run.seconds(2)
    run.core.close()
    assert run.recorded() == list(range(20, 60))
    assert run.core.counters()["lost_deleted"] == 20
    contents = contents_of(run.folder / "recording-2.mcap")
    assert (contents.streams[STREAM].messages, contents.streams[STREAM].missing) == (40, 20)
    assert "messages lost with it: 20" in contents.metadata["paused_because"]
    assert contents.metadata["lost_in_pause"] == "20"
