"""The recorder keeps a clip of each alarm, while it records and across crashes, restarts and full disks."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from fantwin.pipeline.recordings.clips.alarm_clips import AlarmClips, tracker_of
from fantwin.pipeline.recordings.clips.clip import Clip, clips_in, kept_clips, list_path
from fantwin.pipeline.recordings.clips.tracker import ClipTracker, CutResult
from fantwin.pipeline.recordings.clips.worker import ClipWorker
from fantwin.pipeline.recordings.indexed import PartIndex
from fantwin.pipeline.recordings.parts import RecordingParts
from fantwin.pipeline.recordings.reading import RecordingError, read_recording
from fantwin.pipeline.recordings.writing import RecordingWriter
from fantwin.schemas.enums import Severity, Transition
from fantwin.schemas.header import Header
from fantwin.schemas.messages import Alarm
from fantwin.stages.recorder import Recorder, RecorderConfig
from tests.stages.test_recorder import NOW_NS, SECOND_NS, Disk, envelope, old_parts
from tests.support.clipped_recordings import record
from tests.support.offline_replay import recorded, recording_of

FREE = 1 << 40


@pytest.fixture(scope="module")
def chain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An alarm is raised after 1.7 s."""
    return recording_of(tmp_path_factory.mktemp("chain"), 1, 400)


class Maker(ClipWorker):
    """A stand-in for the disk of the clips."""

    def __init__(self) -> None:
        self.asked: list[str] = []
        self.deleted: list[str] = []
        self.saved: list[Clip] = []
        self.waiting: list[CutResult] = []
        self.refuses = self.undeletable = ""

    def save(self, clips: Sequence[Clip]) -> None:
        if not self.refuses:
            self.saved = list(clips)

    def cut(self, clips: Sequence[Clip], open_part: PartIndex | None) -> None:
        self.asked += [clip.name for clip in clips]

    def results(self) -> list[CutResult]:
        results, self.waiting = self.waiting, []
        return results

    def delete(self, clip: Clip) -> None:
        if self.undeletable:
            raise RecordingError(self.undeletable)
        self.deleted.append(clip.name)

    def problem(self) -> str:
        return self.refuses

    def end(self, timeout_s: float) -> None: ...


def clips_of(recording: Path, free: int = FREE, after_s: float = 1.0) -> AlarmClips:
    """As a recorder has them, with short clips."""
    tracker = tracker_of(recording, before_s=0.5, after_s=after_s, most_bytes=0, settled_s=0.3)
    return AlarmClips(tracker, ClipWorker(recording, min_free_bytes=1000, free_bytes=lambda: free))


def raised(fan: int, t_ns: int, **more: Any) -> Alarm:
    fields: dict[str, Any] = {"transition": Transition.RAISED, "active": True, "severity": Severity.ALARM} | more
    about: dict[str, Any] = {"residual_rad_s": 0.0, "residual_std_rad_s": 0.0, "message": "", "confirmed": True}
    return Alarm(header=Header("scorer-1", fan, "tray1"), fan=fan, t_ns=t_ns, onset_t_ns=t_ns, **about, **fields)


def crash(core: Recorder) -> None:
    """The process is gone: the system unlocks the file, and nothing more is written."""
    assert core._part
    core._part._file.close()  # type: ignore[attr-defined]


def test_a_recorder_cuts_a_clip_and_lists_it_while_it_records(chain, tmp_path):
    recording = tmp_path / "recording.mcap"
    core = record(chain, recording, clips=clips_of(recording), part_s=1.0)
    core.close()
    (clip,) = kept_clips(tmp_path / "clips")
    assert not clip.is_due and clip.size_bytes == (tmp_path / "clips" / clip.name).stat().st_size
    assert core.counters()["clips"] == 1 and core.problem() == ""
    (alarm, *_) = recorded(tmp_path / "clips" / clip.name, "alarm")
    assert (alarm.fan, alarm.onset_t_ns) == (clip.alarms[0].fan, clip.alarms[0].onset_t_ns)


@pytest.mark.parametrize("ends", ["by a crash", "in order"])
def test_a_clip_that_was_due_at_the_end_of_a_recorder_is_cut_by_the_next_one(chain, tmp_path, ends):
    recording = tmp_path / "recording.mcap"
    clips = clips_of(recording, after_s=60)
    core = record(chain, recording, clips=clips)
    if ends == "by a crash":
        clips._maker.end(60)  # the list is on the disk
        crash(core)
        assert not kept_clips(tmp_path / "clips")
    else:
        core.close()
        assert kept_clips(tmp_path / "clips"), "as much as there is"
    (due,) = clips_in(list_path(recording))
    assert due.is_due
    core = Recorder(RecordingParts(recording, {}, {}, "s2"), RecorderConfig(), NOW_NS, clips=clips_of(recording))
    core.tick(due.until_ns + SECOND_NS)
    core.close()
    (clip,) = kept_clips(tmp_path / "clips")
    assert clip.name == due.name and not clip.is_due
    assert sum(1 for _ in read_recording(tmp_path / "clips" / clip.name, ("raw",))) > 300


def test_an_alarm_of_which_only_the_recording_knows_after_a_crash_gets_its_clip(chain, tmp_path):
    recording = tmp_path / "recording.mcap"
    crash(record(chain, recording))  # without clips: killed before anything was written down of them
    parts = RecordingParts(recording, {}, {}, "s2")
    clips = clips_of(recording)
    assert parts.last_part
    clips.continue_after(parts.last_part)
    core = Recorder(parts, RecorderConfig(), NOW_NS, clips=clips)
    core.tick(2 * 10**18)
    core.close()
    assert len(kept_clips(tmp_path / "clips")) == 1


def test_no_clip_is_cut_where_that_would_fill_the_disk_and_the_recorder_says_so(chain, tmp_path):
    recording = tmp_path / "recording.mcap"
    clips = clips_of(recording, free=2000)
    core = record(chain, recording, clips=clips)
    clips._maker.end(60)
    core.tick(2 * 10**18)
    assert "cannot be cut yet" in core.problem() and "are free on the disk" in core.problem()
    assert not kept_clips(tmp_path / "clips")
    core.close()


def test_the_disk_guard_takes_what_is_oldest_but_no_unacknowledged_clip_and_last_what_a_clip_needs():
    disk, maker = Disk(), Maker()
    config = RecorderConfig(min_free_bytes=50_000_000)
    core = Recorder(disk, config, NOW_NS, clips=AlarmClips(ClipTracker((), 60, 60, 0), maker))
    now_ns = NOW_NS
    for fan in range(2):
        core.step(envelope(raised(fan, now_ns), "alarm", now_ns))
        now_ns += 70 * SECOND_NS
        core.tick(now_ns)
        maker.waiting = [CutResult(maker.asked[-1], 100)]
        core.tick(now_ns)
    core.step(envelope(raised(0, now_ns, acknowledged=True, transition=Transition.ACKNOWLEDGED), "alarm", now_ns))
    core.step(envelope(raised(2, now_ns), "alarm", now_ns))
    acknowledged, _, running = [clip.name for clip in core._clips._tracker.clips]  # type: ignore[union-attr]
    disk.free, disk.old = 1, old_parts("r-0.mcap", "r-1.mcap", last_ns=NOW_NS - 1000 * SECOND_NS)
    core.tick(now_ns := now_ns + SECOND_NS)
    assert disk.old_names == ["r-1.mcap"] and maker.deleted == []  # this part is older than any clip
    disk.old = old_parts("r-1.mcap", "r-2.mcap", last_ns=now_ns)
    maker.undeletable = f"clips/{acknowledged}: cannot be deleted: Operation not permitted; delete or move it"
    core.tick(now_ns := now_ns + SECOND_NS)
    assert maker.undeletable in core.problem() and core.counters().get("clips_deleted", 0) == 0
    maker.undeletable = ""
    core.tick(now_ns := now_ns + SECOND_NS)
    assert disk.old_names == ["r-1.mcap", "r-2.mcap"] and maker.deleted == [acknowledged]
    assert core.problem() == ""
    core.tick(now_ns := now_ns + SECOND_NS)
    assert disk.old_names == ["r-2.mcap"]  # the running clip needs the other, but the disk is full
    lacking = next(clip for clip in maker.saved if clip.name == running)
    assert lacking.problem == "a part that it needs was deleted to make room"
    core.tick(now_ns + SECOND_NS)
    assert "NOTHING IS RECORDED" in core.problem() and len(maker.deleted) == 1
    assert core.counters()["parts_deleted"] == 2 and core.counters()["clips_deleted"] == 1


def test_a_clip_outlives_the_limit_of_days_until_it_is_acknowledged_and_that_is_said_once(caplog):
    disk, maker = Disk(), Maker()
    core = Recorder(disk, RecorderConfig(), NOW_NS, clips=AlarmClips(ClipTracker((), 60, 60, 0), maker))
    core.step(envelope(raised(0, NOW_NS), "alarm", NOW_NS))
    core.tick(NOW_NS + 70 * SECOND_NS)
    maker.waiting = [CutResult(maker.asked[0], 5_000_000)]
    core.tick(NOW_NS + 80 * SECOND_NS)
    now_ns = NOW_NS
    for day in range(15, 20):
        now_ns = NOW_NS + day * 86_400 * SECOND_NS
        core.tick(now_ns)
    said = "clips kept beyond 14 days until their alarms are acknowledged: 1, 5 MB"
    assert maker.deleted == [] and core.notes()[1] == said and caplog.text.count(said) == 1
    core.step(envelope(raised(0, NOW_NS, acknowledged=True, transition=Transition.ACKNOWLEDGED), "alarm", now_ns))
    core.tick(now_ns + 10 * SECOND_NS)
    assert maker.deleted == maker.asked and len(core.notes()) == 1


def test_of_clips_that_cannot_be_deleted_none_is_forgotten_and_the_first_is_named(tmp_path):
    names = ["1.mcap", "2.mcap"]
    clips = [Clip(name, "tray1", 0, at, 0, (), is_due=False, size_bytes=100) for at, name in enumerate(names)]
    tracker = ClipTracker(clips, 1, 1, most_bytes=100)
    of = AlarmClips(tracker, ClipWorker(tmp_path / "recording.mcap", 0, lambda: FREE))
    in_the_way = tmp_path / "clips" / names[0]
    in_the_way.mkdir(parents=True)
    of.tick(NOW_NS, lambda: None)
    assert tracker.clips == clips and of.problem().startswith(f"{in_the_way}: cannot be deleted: ")
    with pytest.raises(RecordingError, match=r"1\.mcap: cannot be deleted"):
        of.delete_oldest_acknowledged()
    in_the_way.rmdir()
    of.tick(NOW_NS, lambda: None)
    assert tracker.clips == [] and of.problem() == "" and of.counters()["clips_deleted"] == 2
    of.close(lambda: None)


def test_files_that_a_killed_recorder_left_of_a_clip_are_removed_and_what_another_one_is_writing_stays(tmp_path):
    recording, folder = tmp_path / "recording.mcap", tmp_path / "clips"
    folder.mkdir()
    (folder / ".unfinished-tray1-0.mcap.active").touch()
    (folder / "tray1-0.mcap").touch()
    with RecordingWriter(folder / ".unfinished-tray2-0.mcap", {}):
        clips_of(recording)
        assert sorted(path.name for path in folder.iterdir()) == [".unfinished-tray2-0.mcap.active", "tray1-0.mcap"]


def test_while_a_clip_is_cut_the_disk_guard_has_room_at_once_and_the_list_is_written_at_the_end(tmp_path):
    is_cutting, may_go_on = threading.Event(), threading.Event()

    def free_bytes() -> int:
        is_cutting.set()
        may_go_on.wait(60)
        return 0

    recording = tmp_path / "recording.mcap"
    worker = ClipWorker(recording, 0, free_bytes)
    old, slow = (Clip(name, "tray1", 0, 1, 0, (), is_due=False) for name in ("old.mcap", "slow.mcap"))
    (tmp_path / "clips").mkdir()
    (tmp_path / "clips" / old.name).touch()
    worker.cut([slow], None)
    assert is_cutting.wait(60)
    worker.delete(old)
    is_there = (tmp_path / "clips" / old.name).exists()
    worker.end(0.0)
    worker.save([slow])
    listed = list_path(recording).exists() and clips_in(list_path(recording))
    may_go_on.set()
    assert not is_there and listed == [slow]


def test_the_list_that_a_full_disk_has_refused_is_written_once_there_is_room():
    maker = Maker()
    core = Recorder(Disk(), RecorderConfig(), NOW_NS, clips=AlarmClips(ClipTracker((), 60, 60, 0), maker))
    maker.refuses = "clips: cannot be written: No space left on device"
    for _ in range(2):  # a restarted recorder receives it again
        core.step(envelope(raised(0, NOW_NS), "alarm", NOW_NS))
    core.tick(NOW_NS + SECOND_NS)
    assert maker.saved == []
    maker.saved, real_save = [], maker.save

    def save(clips: Sequence[Clip]) -> None:
        maker.refuses = ""
        real_save(clips)

    maker.save = save  # type: ignore[method-assign]
    core.tick(NOW_NS + 2 * SECOND_NS)
    assert maker.saved == []
    core.tick(NOW_NS + 12 * SECOND_NS)
    assert len(maker.saved) == 1 and core.problem() == ""


def test_a_clip_is_not_cut_before_what_was_received_in_a_pause_is_on_the_disk():
    disk, maker = Disk(), Maker()
    core = Recorder(disk, RecorderConfig(), NOW_NS, clips=AlarmClips(ClipTracker((), 60, 60, 0), maker))
    core.step(envelope(raised(0, NOW_NS), "alarm", NOW_NS))
    core.tick(NOW_NS + 2 * SECOND_NS)
    disk.free = 1
    core.tick(NOW_NS + 4 * SECOND_NS)
    core.step(envelope(raised(0, NOW_NS, transition=Transition.CLEARED), "alarm", NOW_NS + 5 * SECOND_NS))
    core.tick(NOW_NS + 70 * SECOND_NS)
    assert "NOTHING IS RECORDED" in core.problem() and maker.asked == []
    disk.free = FREE
    core.tick(NOW_NS + 72 * SECOND_NS)
    assert core.problem() == "" and core.unsaved() and maker.asked == []
    core.tick(NOW_NS + 75 * SECOND_NS)
    assert not core.unsaved() and len(maker.asked) == 1
