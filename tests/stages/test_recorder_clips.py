"""The recorder keeps a clip of each alarm, while it records and across crashes, restarts and full disks."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from fantwin.pipeline.recordings.clips import tracker
from fantwin.pipeline.recordings.clips.alarm_clips import AlarmClips
from fantwin.pipeline.recordings.clips.clip import Clip, clips_in, kept_clips, list_path
from fantwin.pipeline.recordings.clips.cutting import ClipCutter
from fantwin.pipeline.recordings.clips.tracker import ClipTracker, CutResult
from fantwin.pipeline.recordings.parts import RecordingParts
from fantwin.pipeline.recordings.reading import read_recording
from fantwin.pipeline.recordings.recorder import Recorder
from fantwin.pipeline.recordings.recorder_config import RecorderConfig
from fantwin.schemas.enums import Transition
from fantwin.schemas.messages import Alarm
from tests.support.clipped_recordings import record
from tests.support.made_messages import alarm
from tests.support.offline_replay import recorded, recording_of
from tests.support.stub_disk import NOW_NS, SECOND_NS, Disk, envelope

FREE = 1 << 40


@pytest.fixture(scope="module")
def chain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An alarm is raised after 1.7 s."""
    return recording_of(tmp_path_factory.mktemp("chain"), 1, 400)


@pytest.fixture(autouse=True)
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """A recorder that stops waits for its clips however busy the machine is."""
    monkeypatch.setattr("fantwin.pipeline.recordings.clips.alarm_clips.CLOSE_S", 300.0)


class Cutter:
    """Cuts clips of a stated size, and knows which."""

    def __init__(self) -> None:
        self.asked: list[str] = []
        self.size_bytes = 100

    def cut(self, clip: Clip) -> CutResult:
        self.asked.append(clip.name)
        return CutResult(clip.name, self.size_bytes)


@pytest.fixture
def clips_of(monkeypatch: pytest.MonkeyPatch) -> Callable[..., AlarmClips]:
    """Makes clips as a recorder has them, but short."""

    def make(recording: Path, after_s: float = 1.0) -> AlarmClips:
        for name, seconds in (("BEFORE_NS", 0.5), ("AFTER_NS", after_s), ("SETTLED_NS", 0.3)):
            monkeypatch.setattr(tracker, name, round(seconds * SECOND_NS))
        of_recording = ClipTracker(clips_in(list_path(recording)), most_bytes=0)
        return AlarmClips(
            of_recording, recording, ClipCutter(recording, lambda: FREE, least_free_bytes=lambda: 1000).cut
        )

    return make


def with_cutter(disk: Disk, folder: Path, **config: Any) -> tuple[Recorder, AlarmClips, Cutter]:
    """A recorder whose clips are cut by a stand-in."""
    cutter = Cutter()
    clips = AlarmClips(ClipTracker((), 0, kept_s=14 * 86_400.0), folder / "recording.mcap", cutter.cut)
    return Recorder(disk, RecorderConfig(**config), NOW_NS, clips), clips, cutter


def tick_until_cut(core: Recorder, clips: AlarmClips, now_ns: int) -> None:
    """A tick at which clips are due, and one that takes them."""
    core.tick(now_ns)
    assert clips._thread
    clips._thread.join(60)
    core.tick(now_ns)


def raised(fan: int, t_ns: int, **more: Any) -> Alarm:
    return alarm(fan, t_ns, sequence=fan, **{"transition": Transition.RAISED, **more})


def crash(core: Recorder) -> None:
    """The process is gone: the system unlocks the file, and nothing more is written."""
    assert core._part
    core._part._file.close()  # type: ignore[attr-defined]


def test_a_recorder_cuts_a_clip_and_lists_it_while_it_records(chain, tmp_path, clips_of):
    recording = tmp_path / "recording.mcap"
    core = record(chain, recording, clips=clips_of(recording), part_s=1.0)
    core.close()
    (clip,) = kept_clips(tmp_path / "clips")
    assert not clip.is_due and clip.size_bytes == (tmp_path / "clips" / clip.name).stat().st_size
    assert core.counters()["clips"] == 1 and core.problem() == ""
    (alarm, *_) = recorded(tmp_path / "clips" / clip.name, "alarm")
    assert (alarm.fan, alarm.onset_t_ns) == (clip.alarms[0].fan, clip.alarms[0].onset_t_ns)


@pytest.mark.parametrize("ends", ["by a crash", "in order"])
def test_a_clip_that_was_due_at_the_end_of_a_recorder_is_cut_by_the_next_one(chain, tmp_path, clips_of, ends):
    recording = tmp_path / "recording.mcap"
    clips = clips_of(recording, after_s=60)
    core = record(chain, recording, clips=clips)
    crash(core) if ends == "by a crash" else core.close()
    assert not kept_clips(tmp_path / "clips")
    (due,) = clips_in(list_path(recording))
    assert due.is_due
    core = Recorder(RecordingParts(recording, {}, {}, "s2"), RecorderConfig(), NOW_NS, clips_of(recording))
    core.tick(due.until_ns + SECOND_NS)
    core.close()
    (clip,) = kept_clips(tmp_path / "clips")
    assert clip.name == due.name and not clip.is_due
    assert sum(1 for _ in read_recording(tmp_path / "clips" / clip.name, ("raw",))) > 300


def test_a_clip_outlives_the_limit_of_days_until_it_is_acknowledged_and_that_is_said(tmp_path):
    core, clips, cutter = with_cutter(Disk(), tmp_path)
    cutter.size_bytes = 5_000_000
    core.step(envelope(raised(0, NOW_NS), "alarm", NOW_NS))
    tick_until_cut(core, clips, NOW_NS + 70 * SECOND_NS)
    (clip,) = clips.tracker.clips
    (tmp_path / "clips" / clip.name).touch()
    now_ns = NOW_NS + 15 * 86_400 * SECOND_NS
    core.tick(now_ns)
    said = "clips kept beyond recorder.keep_days until their alarms are acknowledged: 1, 5 MB"
    assert clips.tracker.clips and core.notes()[1] == said
    core.step(envelope(raised(0, NOW_NS, acknowledged=True, transition=Transition.ACKNOWLEDGED), "alarm", now_ns))
    core.tick(now_ns + 10 * SECOND_NS)
    assert not clips.tracker.clips and len(core.notes()) == 1
    assert not (tmp_path / "clips" / clip.name).exists() and core.counters()["clips_deleted"] == 1


def test_a_clip_is_not_cut_before_what_was_received_in_a_pause_is_on_the_disk(tmp_path):
    disk = Disk()
    core, clips, cutter = with_cutter(disk, tmp_path)
    core.step(envelope(raised(0, NOW_NS), "alarm", NOW_NS))
    core.tick(NOW_NS + 2 * SECOND_NS)
    disk.free = 1
    core.tick(NOW_NS + 4 * SECOND_NS)
    core.step(envelope(raised(0, NOW_NS, transition=Transition.CLEARED), "alarm", NOW_NS + 5 * SECOND_NS))
    core.tick(NOW_NS + 70 * SECOND_NS)
    assert "NOTHING IS RECORDED" in core.problem()
    disk.free = FREE
    core.tick(NOW_NS + 72 * SECOND_NS)
    assert core.problem() == "" and not core.unsaved()
    tick_until_cut(core, clips, NOW_NS + 75 * SECOND_NS)
    assert not core.unsaved() and len(cutter.asked) == 1
