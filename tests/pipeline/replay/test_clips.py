"""Alarm clips of a chain's recording: what they hold, and that they decide the same again."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from fantwin.pipeline.recordings.clips.clip import Clip, clip_lines
from fantwin.pipeline.recordings.clips.cutting import ClipCutter
from fantwin.pipeline.recordings.contents import contents_of
from fantwin.pipeline.recordings.reading import read_metadata, read_recording
from fantwin.pipeline.recordings.records import active_path
from fantwin.pipeline.recordings.writing import RecordingWriter
from fantwin.pipeline.replay.offline.comparison import CannotCompareError
from fantwin.pipeline.replay.offline.offline_pipeline import OfflinePipeline
from fantwin.pipeline.replay.offline.replay_input import open_replay_input
from fantwin.pipeline.replay.offline.rescoring import RescoredTray, rescore
from fantwin.schemas.enums import Action, Transition
from fantwin.schemas.messages import Alarm, Score, ScorerSnapshot
from tests.support.clipped_recordings import S, clip_of, of_tray, record
from tests.support.failing_writers import disk_of
from tests.support.killed_site import Site
from tests.support.offline_replay import recorded, verified

MADE = ("grid", "prediction", "score")
MARGIN_S = 0.8


def first_raised(path: Path) -> Alarm:
    return next(alarm for alarm in recorded(path, "alarm") if alarm.transition == Transition.RAISED)


def cutter(recording: Path, **more: Any) -> ClipCutter:
    """A cutter of clips on a disk with room."""
    return ClipCutter(recording, **{"free_bytes": lambda: 1 << 40, **more})


def cut(source: Path, folder: Path, left_out: tuple[str, ...] = ()) -> Path:
    """The clip of the first alarm of a recording, from its parts, the last of which is still being written."""
    clip = clip_of(first_raised(source), before_s=0.5, after_s=2.0)
    core = record(source, folder / "recording.mcap", left_out, part_s=1.0)
    result = cutter(folder / "recording.mcap", margin_s=MARGIN_S).cut(clip)
    core.close()
    assert result.size_bytes == (folder / "clips" / clip.name).stat().st_size
    assert not result.problem
    return folder / "clips" / clip.name


def again(path: Path) -> RescoredTray:
    with open_replay_input([path], None, (), None) as replay_input:
        (tray,) = rescore(replay_input, None, verify=False)
    return tray


@pytest.fixture(scope="module")
def clip(undisturbed: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The clip of the first alarm of the undisturbed recording."""
    return cut(undisturbed, tmp_path_factory.mktemp("clip"))


def test_a_clip_has_every_message_of_its_time_with_its_bytes(undisturbed, clip):
    alarm = first_raised(undisturbed)
    window = range(alarm.t_ns - S // 2, alarm.t_ns + 2 * S + 1)
    wanted = [(e.key, e.payload, e.received_t_ns) for e in read_recording(undisturbed) if e.received_t_ns in window]
    found = [(e.key, e.payload, e.received_t_ns) for e in read_recording(clip) if e.received_t_ns in window]
    assert len(wanted) > 225
    assert [each for each in found if each in wanted] == wanted
    (snapshot, *_) = recorded(clip, "snapshot")
    (taken_ns, *_) = [each.received_t_ns for each in read_recording(undisturbed, ("snapshot",))]
    before_s = (taken_ns - recorded(clip, "raw")[0].host_receive_t_ns[-1]) / S
    assert MARGIN_S - 0.05 < before_s <= MARGIN_S
    assert recorded(clip, "prediction")[0].t_ns[0] == snapshot.t_ns + 10_000_000
    contents = contents_of(clip)
    assert not contents.damage and not any(counts.missing for counts in contents.streams.values())
    assert "raised 2027-01-15" in clip_lines(contents.metadata)[0]


def test_the_same_alarm_comes_out_of_a_clip_again_from_its_snapshot_on(undisturbed, clip):
    alarm = first_raised(undisturbed)
    tray = again(clip)
    (raised,) = [each for each in tray.alarms if each.transition == Transition.RAISED]
    assert (raised.fan, raised.severity, raised.statistic) == (alarm.fan, alarm.severity, alarm.statistic)
    assert abs(raised.t_ns - alarm.t_ns) < 0.1 * S
    assert tray.lost == 0
    with open_replay_input([clip], None, (), None) as replay_input:
        plan, _, _ = replay_input.read_plan("tray1")
        first, second, *_ = (message for _, message in replay_input.pipeline("tray1", plan).run())
    assert isinstance(first, ScorerSnapshot) and first.restored
    assert first.state_json == recorded(clip, "snapshot")[0].state_json
    assert isinstance(second, Score) and second.t_ns[0] > first.t_ns


def test_the_same_alarm_comes_out_of_a_clip_with_raw_samples_only(undisturbed, tmp_path):
    alarm = first_raised(undisturbed)
    clip = cut(undisturbed, tmp_path, MADE)
    (raised,) = [each for each in again(clip).alarms if each.transition == Transition.RAISED]
    assert (raised.fan, raised.severity) == (alarm.fan, alarm.severity)


def test_a_clip_of_the_time_before_the_clock_was_set_back_is_cut_from_the_part_of_that_time(undisturbed, tmp_path):
    """What a power cut does on a board whose clock begins in the past: the next part has earlier times."""
    recording = tmp_path / "recording.mcap"
    record(undisturbed, recording).close()
    head = read_metadata(recording)
    with RecordingWriter(tmp_path / "recording-2.mcap", head.metadata, head.attachments) as later:
        for envelope in list(read_recording(undisturbed))[:100]:
            later.add(envelope.received_at(envelope.received_t_ns - 3600 * S))
    clip = clip_of(first_raised(undisturbed), before_s=0.5, after_s=2.0)
    result = cutter(recording, margin_s=MARGIN_S).cut(clip)
    assert result.size_bytes and not result.problem
    assert recorded(tmp_path / "clips" / clip.name, "raw")


def test_a_clip_is_not_verified_and_why_is_said_before_it_is_scored(clip, monkeypatch):
    monkeypatch.setattr(OfflinePipeline, "run", lambda _pipeline: pytest.fail("it is scored"))
    with pytest.raises(CannotCompareError, match="without --verify .* or verify the recording that it was cut from"):
        verified(clip)


def test_a_clip_whose_snapshot_lacks_evidence_has_its_alarm_at_about_the_same_time(tmp_path):
    """It begins with a snapshot of just after the onset, which keeps little evidence of the fault."""
    site = Site(tmp_path, 1, raw_samples=4)
    site.run(170)
    site.ask(Action.SHELVE, 2, duration_s=1.0)  # for its snapshot
    site.run(150)
    source = site.finished()
    (shelved,) = [alarm for alarm in recorded(source, "alarm") if alarm.transition == Transition.SHELVED]
    alarm = first_raised(source)
    assert alarm.onset_t_ns < shelved.t_ns < alarm.t_ns
    clip = clip_of(alarm, before_s=0.05, after_s=1.0)
    record(source, tmp_path / "parts" / "recording.mcap", part_s=1.0).close()
    cutter(tmp_path / "parts" / "recording.mcap", margin_s=0.5).cut(clip)
    (raised,) = [each for each in again(tmp_path / "parts" / "clips" / clip.name).alarms if each.fan == alarm.fan]
    assert raised.transition == Transition.RAISED and abs(raised.t_ns - alarm.t_ns) < S


def test_a_clip_has_its_tray_only(undisturbed, tmp_path):
    source = tmp_path / "two-trays.mcap"
    head = read_metadata(undisturbed)
    about = {"trays": "tray1,tray2", "fans.tray1": "3", "fans.tray2": "3"}
    twins = {**head.attachments, "tray2.onnx": b"another twin"}
    with RecordingWriter(source, {**head.metadata, **about}, twins) as writer:
        for envelope in read_recording(undisturbed):
            writer.add(envelope)
            writer.add(of_tray(envelope, "tray2"))
    clip = cut(source, tmp_path / "runs")
    assert {envelope.key.split("/")[2] for envelope in read_recording(clip)} == {"tray1"}
    found = read_metadata(clip)
    assert found.trays == ("tray1",)
    assert "fans.tray2" not in found.metadata
    assert set(found.attachments) == {"configuration.toml", "tray1.onnx"}


def test_what_cannot_be_written_leaves_no_file_and_can_be_tried_again(undisturbed, tmp_path):
    clip = clip_of(first_raised(undisturbed), before_s=0.5, after_s=2.0)
    record(undisturbed, tmp_path / "recording.mcap", part_s=1.0).close()
    folder = tmp_path / "clips"
    with disk_of(40_000):
        result = cutter(tmp_path / "recording.mcap").cut(clip)
    assert result.may_pass and not result.size_bytes and "File too large" in result.problem
    assert list(folder.glob("*.mcap*")) == []
    room = iter([5_000_000, 1_000_000, 1_000, 1_000])
    result = cutter(tmp_path / "recording.mcap", free_bytes=lambda: next(room), least_free_bytes=lambda: 10_000).cut(
        clip
    )
    assert result.may_pass and not result.size_bytes and "0.0 MB are free" in result.problem
    assert list(folder.glob("*.mcap*")) == [], "room ran out while it was written"
    result = cutter(tmp_path / "recording.mcap").cut(clip)
    assert result.size_bytes and [path.name for path in folder.glob("*.mcap*")] == [clip.name]


def test_a_clip_of_parts_that_are_gone_is_not_written_and_one_of_some_has_the_rest(undisturbed, tmp_path):
    alarm = first_raised(undisturbed)
    record(undisturbed, tmp_path / "recording.mcap", part_s=1.0).close()
    (tmp_path / "recording.mcap").unlink()
    clip = clip_of(alarm, before_s=0.5, after_s=2.0)
    result = cutter(tmp_path / "recording.mcap").cut(clip)
    assert result.size_bytes and result.problem == "parts that it needs were deleted to make room"
    first = recorded(tmp_path / "clips" / clip.name, "raw")[0].host_receive_t_ns[0]
    assert first == recorded(tmp_path / "recording-2.mcap", "raw")[0].host_receive_t_ns[0]
    past = Clip("past.mcap", "tray1", 5 * S, 9 * S, 5 * S, clip.alarms)
    result = cutter(tmp_path / "recording.mcap").cut(past)
    assert (result.size_bytes, result.may_pass) == (0, False)
    assert "nothing of that time is recorded" in result.problem
    assert not active_path(tmp_path / "clips" / past.name).exists()
