"""A real disk that fills or is unmounted: earlier parts stay intact, recording resumes, and the gap is reported."""

from __future__ import annotations

import re
from itertools import count
from pathlib import Path

import pytest
from mcap.reader import make_reader

from fantwin.pipeline.recordings import disk_room
from fantwin.pipeline.recordings.reading import read_metadata, read_recording
from fantwin.pipeline.recordings.recorder import Recorder
from fantwin.stages.recorder import STAGE
from tests.support.small_disk import SIZE_BYTES, mount, unmount
from tests.support.stub_disk import SECOND_NS, context, envelope
from tests.support.written_recordings import raw


@pytest.fixture(autouse=True)
def all_may_be_filled(monkeypatch: pytest.MonkeyPatch) -> None:
    """The recorder leaves no space for others: the disk itself refuses."""
    monkeypatch.setattr("fantwin.pipeline.recordings.disk.LEAST_FREE_BYTES", 0)


class Run:
    """A recorder that is fed 50 incompressible messages, about 100 kB, a second."""

    def __init__(self, folder: Path, **config) -> None:
        self.folder = folder / "runs"
        self.numbers = count()
        self.seconds = count(1)
        self.begin(folder, **config)

    def begin(self, folder: Path, **config) -> None:
        core = STAGE.build(context(folder, **{"keep_share_of_disk": 1.0, **config})).core
        assert isinstance(core, Recorder)
        self.core = core

    def second(self) -> None:
        now_ns = 1_800_000_000_250_000_000 + next(self.seconds) * SECOND_NS
        for _ in range(50):
            self.core.step(envelope(raw(next(self.numbers), samples=100), "raw", now_ns))
        self.core.tick(now_ns)

    @property
    def sent(self) -> int:
        return int(re.findall(r"\d+", repr(self.numbers))[0])

    def parts(self) -> list[Path]:
        def number(path: Path) -> int:
            return int((re.findall(r"-(\d+)\.mcap$", path.name) or ["1"])[0])

        return sorted(self.folder.glob("*.mcap"), key=number)

    def sequences(self) -> list[int]:
        return [envelope.message.header.sequence for path in self.parts() for envelope in read_recording(path)]


def assert_readable(path: Path) -> None:
    """Messages read by the mcap library, which must find every checksum correct."""
    with path.open("rb") as file:
        for _ in make_reader(file, validate_crcs=True).iter_messages():
            pass
    assert read_recording(path).damage == ""


def until(happens, run: Run) -> None:
    for _ in range(200):
        if happens():
            return
        run.second()
    raise AssertionError("it never happened")


def test_a_full_disk_loses_nothing_that_memory_can_hold(small_disk, monkeypatch):
    monkeypatch.setattr(disk_room, "PART_BYTES", 1_000_000)
    run = Run(small_disk)
    ballast = small_disk / "ballast"
    ballast.write_bytes(bytes(SIZE_BYTES - 900_000))
    until(run.core.problem, run)
    before = {path: path.read_bytes() for path in run.parts()}
    assert re.search(r"NOTHING IS RECORDED: .*make room", run.core.problem())
    for _ in range(5):
        run.second()
    assert run.core.problem(), "there is still no room"
    assert {path: path.read_bytes() for path in before} == before, "the last part is intact"
    for path in run.parts():
        assert_readable(path)
    ballast.unlink()
    until(lambda: not run.core.problem(), run)
    run.core.close()
    assert run.core.counters()["lost_unwritten"] == 0
    assert run.sequences() == list(range(run.sent))
    assert not list(run.folder.glob("*.active"))
    (shown,) = [head for head in (read_metadata(path).metadata for path in run.parts()) if "paused_t_ns" in head]
    assert int(shown["resumed_t_ns"]) - int(shown["paused_t_ns"]) >= 5 * SECOND_NS
    assert "No space left on device" in shown["paused_because"]
    for path in run.parts():
        assert_readable(path)


def test_an_unmounted_disk_is_waited_for_and_its_mount_point_not_written(small_disk):
    run = Run(small_disk)
    for _ in range(3):
        run.second()
    unmount(small_disk)
    until(run.core.problem, run)
    first_held = run.sent - 50
    assert "disk: the disk is no longer mounted; mount it again" in run.core.problem()
    for _ in range(3):
        run.second()
    assert list(small_disk.iterdir()) == []
    assert mount(small_disk)
    (small_disk / "runs").mkdir()
    until(lambda: not run.core.problem(), run)
    run.core.close()
    (part,) = run.parts()
    assert part.name == "recording-2.mcap"
    assert read_metadata(part).metadata["continues"] == "recording.mcap"
    sequences = run.sequences()
    assert first_held - 50 <= sequences[0] <= first_held + 50
    assert sequences == list(range(sequences[0], run.sent))


def test_a_recorder_killed_on_a_full_disk_is_followed_by_one_that_waits_and_loses_no_part(small_disk):
    run = Run(small_disk)
    for _ in range(5):
        run.second()
    part = run.core._part
    assert part is not None
    part.flush()
    part._file.close()  # type: ignore[attr-defined]  as kill -9 does
    recorded = part.written["raw"]
    with (small_disk / "ballast").open("wb", buffering=0) as ballast, pytest.raises(OSError, match="No space"):
        while True:
            ballast.write(bytes(4096))
    run.begin(small_disk)
    assert run.core.problem()
    assert len(run.sequences()) == recorded
    (small_disk / "ballast").unlink()
    until(lambda: not run.core.problem(), run)
    run.core.close()
    assert run.sequences() == [*range(recorded), *range(250, run.sent)]
