"""What a full disk, wrong clocks, odd file systems and programs that delete or cut the file must not cost."""

from __future__ import annotations

import errno
import logging
import os
import shutil
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import pytest

from fantwin.pipeline.recordings.contents import contents_of
from fantwin.pipeline.recordings.disk_room import DAY_NS, DiskRoom
from fantwin.pipeline.recordings.parts import RecordingParts
from fantwin.pipeline.recordings.reading import read_metadata, read_recording
from fantwin.pipeline.recordings.recorder import Recorder
from fantwin.pipeline.recordings.recorder_config import RecorderConfig
from fantwin.pipeline.recordings.sequence_ledger import SequenceLedger
from fantwin.pipeline.recordings.stored_recordings import StoredPart
from fantwin.stages.recorder import STAGE
from tests.support.stub_disk import NOW_NS, RAW_KEY, SECOND_NS, Disk, context, envelope, old_parts, raw, recorder


def ten_days_of_parts() -> list[StoredPart]:
    return [StoredPart(NOW_NS + number * DAY_NS, number, Path(f"r-{number}.mcap")) for number in range(1, 11)]


def test_on_a_full_disk_the_oldest_parts_go_one_at_a_time_and_what_others_take_costs_no_more(caplog):
    disk = Disk()
    disk.old, disk.freed_by_each = old_parts("oldest.mcap", "history-1.mcap", "history-2.mcap"), 10_000_000
    core = recorder(disk)
    disk.free = 95_000_000
    for second in range(1, 4):
        core.tick(NOW_NS + second * SECOND_NS)
    assert disk.old_names == ["history-1.mcap", "history-2.mcap"] and core.problem() == ""
    assert "oldest.mcap, the oldest part, was deleted: the disk runs short" in caplog.text
    disk.free, disk.freed_by_each = 1, 0  # others take all that a deletion makes free
    for second in range(4, 11):
        core.step(envelope(raw(second), "raw", NOW_NS))
        core.tick(NOW_NS + second * SECOND_NS)
    assert disk.parts[0].closed and len(disk.stored().parts) == 2, "the pause has ended a part"
    assert disk.old_names == ["history-2.mcap"] and core.counters()["parts_deleted"] == 2
    assert core.problem().startswith("NOTHING IS RECORDED")
    disk.free = 1 << 40
    core.tick(NOW_NS + 11 * SECOND_NS)
    assert core.problem() == ""
    disk.free = 1
    core.tick(NOW_NS + 12 * SECOND_NS)
    assert disk.old_names == [], "there was room meanwhile: the oldest goes again"


def test_a_clock_that_is_years_ahead_costs_a_part_an_hour_and_never_the_last():
    disk, hours = Disk(), [0.0]
    disk.old = ten_days_of_parts()
    room = DiskRoom(disk, RecorderConfig(), monotonic_s=lambda: hours[-1] * 3600)
    for look in range(60):
        room.keep_limits(NOW_NS + (3650 + look) * DAY_NS)
    assert len(disk.old) == 9
    hours.append(0.99)
    room.keep_limits(NOW_NS + 3650 * DAY_NS)
    assert len(disk.old) == 9
    hours.append(1.0)
    room.keep_limits(NOW_NS + 3650 * DAY_NS)
    assert len(disk.old) == 8
    room.keep_limits(NOW_NS + 3650 * DAY_NS, has_ended_part=True)
    assert len(disk.old) == 7, "as fast as parts are made, so that a busy site keeps the limit"
    for hour in range(2, 30):
        hours.append(hour)
        room.keep_limits(NOW_NS + 3650 * DAY_NS)
    assert disk.old_names == ["r-10.mcap"]


@pytest.fixture
def sizeless(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every file system reports zeros, as some of FUSE do."""
    monkeypatch.setattr("fantwin.pipeline.recordings.disk.os.statvfs", lambda _: os.statvfs_result((0,) * 10))


@pytest.mark.usefixtures("sizeless")
def test_on_a_file_system_that_does_not_say_its_size_nothing_is_recorded_or_deleted_and_health_says_so(tmp_path):
    run = context(tmp_path, keep_days=1)
    parts = RecordingParts(run.run_folder / "recording.mcap", {}, {}, "earlier")
    for _ in range(3):
        parts.begin(1, SequenceLedger(), {}).finish()
    core = STAGE.build(run).core
    for sequence in range(3):
        core.step(envelope(raw(sequence), "raw", NOW_NS))
    for second in range(1, 30):
        core.tick(NOW_NS + second * SECOND_NS)
    assert len(parts.stored().parts) == 3 and "parts_deleted" not in core.counters()
    assert "the file system does not say its size" in core.problem()
    assert core.problem().startswith("NOTHING IS RECORDED")
    core.close()


def test_a_part_that_cannot_be_deleted_is_named_in_health_and_once_in_the_log(caplog):
    disk = Disk()
    disk.disk, disk.freed_by_each, disk.old = 1_000_000_000, 30_000_000, ten_days_of_parts()
    disk.undeletable = "runs/r-1.mcap: cannot be deleted: Operation not permitted; move it"
    with caplog.at_level(logging.WARNING):
        core = recorder(disk)
        for second in range(1, 60):
            core.tick(NOW_NS + second * SECOND_NS)
    assert core.problem() == disk.undeletable and caplog.text.count(disk.undeletable) == 1
    disk.free = 1
    core.tick(NOW_NS + 60 * SECOND_NS)
    assert core.problem().startswith("NOTHING IS RECORDED") and disk.undeletable in core.problem()
    disk.free, disk.undeletable = 1 << 40, ""
    for second in range(61, 75):
        core.tick(NOW_NS + second * SECOND_NS)
    assert core.problem() == "" and len(disk.stored().parts) == 2


def test_a_folder_that_cannot_be_read_is_said_and_is_not_taken_for_empty():
    disk = Disk()
    disk.old, disk.refuses_to_list = ten_days_of_parts(), "runs/clips: cannot be read: Permission denied; correct it"
    core = recorder(disk)
    assert core.problem() == disk.refuses_to_list and core.notes() == [] and disk.parts
    disk.refuses_to_list = ""
    core.tick(NOW_NS + 10 * SECOND_NS)
    assert core.problem() == "" and core.notes()


def test_without_enough_free_space_it_pauses_and_finishes_the_part():
    disk = Disk()
    core = recorder(disk)
    for sequence in range(3):
        core.step(envelope(raw(sequence), "raw", NOW_NS))
    disk.free = 99_000_000
    core.tick(NOW_NS + SECOND_NS)
    assert disk.parts[0].closed == "before the next"
    assert core.problem().startswith("NOTHING IS RECORDED: 99.0 MB are free on the disk, but 100.0 MB are required")
    assert core.counters() == {"recorded_raw": 3, "lost_unwritten": 0, "parts": 1, "pauses": 1}
    disk.free = 100_000_001
    core.tick(NOW_NS + 2 * SECOND_NS)
    assert core.problem(), "so little more would be used up at once"
    disk.free = 110_000_000
    core.tick(NOW_NS + 3 * SECOND_NS)
    assert core.problem() == ""
    assert len(disk.parts) == 2


def day_old(disk: Disk, days: float) -> list[StoredPart]:
    return [StoredPart(NOW_NS - round(days * 86_400) * SECOND_NS, 1, Path(f"{days:g}-days.mcap")), *disk.old]


def test_parts_older_than_the_limit_of_days_are_deleted_and_it_is_said(caplog):
    disk = Disk()
    for days in (3, 14.1, 20):
        disk.old = day_old(disk, days)
    with caplog.at_level(logging.WARNING):
        core = recorder(disk)
    assert disk.old_names == ["14.1-days.mcap", "3-days.mcap"], "one at a time, because the clock may be wrong"
    assert "20-days.mcap, the oldest part, was deleted: older than 14 days (recorder.keep_days)" in caplog.text
    assert core.counters()["parts_deleted"] == 1
    assert core.notes()[0] == "recordings: 0 bytes of 1.76 TB, 14.1 of 14 days"
    for hour in range(1, 13 * 24):
        core.tick(NOW_NS + hour * 3600 * SECOND_NS)
    assert disk.old_names == [] and core.counters()["parts_deleted"] == 3
    assert {round((b.t_ns - a.t_ns) / 86_400e9, 1) for a, b in pairwise(disk.parts)} == {1.0}, "a part a day"


def test_the_oldest_parts_are_deleted_when_all_exceed_their_share_of_the_disk(caplog):
    disk = Disk()
    disk.disk, disk.freed_by_each, disk.old = 1_000_000_000, 30_000_000, old_parts("a.mcap", "b.mcap", "c.mcap")
    with caplog.at_level(logging.WARNING):
        core = recorder(disk)
    assert disk.old_names == ["b.mcap", "c.mcap"], "with room for the next part, of an eighth"
    assert "a.mcap, the oldest part, was deleted: recordings and clips would exceed 100 MB" in caplog.text
    assert core.notes()[0].startswith("recordings: 60 MB of 100 MB")
    for sequence in range(13):
        core.step(envelope(raw(sequence, samples=25_000), "raw", NOW_NS))
        core.tick(NOW_NS + (sequence + 1) * SECOND_NS)
    assert disk.parts[0].closed and 12_500_000 <= disk.parts[0].size < 14_000_000


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
