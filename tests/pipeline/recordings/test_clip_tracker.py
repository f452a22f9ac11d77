"""Which alarm clips are due, kept and deleted."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from fantwin.pipeline.recordings.clips.clip import Clip, clip_lines, clips_as_text, kept_clips
from fantwin.pipeline.recordings.clips.tracker import JUDGED_NS, LONGEST_NS, ClipTracker, CutResult
from fantwin.schemas.enums import Severity, Transition
from fantwin.schemas.header import Header
from fantwin.schemas.messages import Alarm

S = 1_000_000_000
T0 = 1_800_000_000 * S


def alarm(fan: int = 0, at_s: float = 0.0, tray: str = "tray1", *, onset_s: float | None = None, **more: Any) -> Alarm:
    fields: dict[str, Any] = {
        "transition": Transition.RAISED,
        "active": True,
        "severity": Severity.ALARM,
        "residual_rad_s": 0.0,
        "residual_std_rad_s": 0.0,
        "message": "",
    }
    onset_t_ns = T0 + round((at_s if onset_s is None else onset_s) * S)
    t_ns = T0 + round(at_s * S)
    return Alarm(header=Header("s-1", 0, tray), fan=fan, t_ns=t_ns, onset_t_ns=onset_t_ns, **{**fields, **more})


def tracker(*clips: Clip, most_bytes: int = 0, **more: Any) -> ClipTracker:
    return ClipTracker(clips, most_bytes, **more)


def follow(tracker: ClipTracker, *alarms: Alarm) -> None:
    for each in alarms:
        tracker.add(each, each.t_ns)


def cut(tracker: ClipTracker, at_s: float, size_bytes: int = 100, **more: Any) -> list[str]:
    """The names of what is due, which is then cut."""
    names = [clip.name for clip in tracker.due(T0 + round(at_s * S))]
    for name in names:
        tracker.cut(CutResult(name, size_bytes, **more))
    return names


def test_an_alarm_gives_a_clip_from_before_its_onset_to_after_it_once_that_is_on_the_disk():
    of = tracker()
    follow(of, alarm(3, 10.0, onset_s=8.0))
    (clip,) = of.clips
    assert (clip.since_ns - T0, clip.until_ns - T0) == (-52 * S, 70 * S)
    assert clip.judged_since_ns == T0 + 8 * S - JUDGED_NS
    assert clip.name == "tray1-3-20270115T080010Z.mcap"
    assert of.due(T0 + 71 * S) == []
    assert cut(of, 72) == [clip.name]
    assert cut(of, 73) == []
    (kept,) = of.clips
    assert (kept.is_due, kept.size_bytes, kept.is_acknowledged) == (False, 100, False)


def test_alarms_of_a_tray_that_come_while_its_clip_runs_share_it_and_those_of_others_do_not():
    of = tracker()
    follow(of, *(alarm(fan, fan * 0.1) for fan in range(500)), alarm(0, 1.0, "tray2"), alarm(1, 100.0))
    mine, other = of.clips
    assert [each.fan for each in mine.alarms] == [*range(500), 1]
    assert mine.until_ns == T0 + 160 * S
    assert other.tray == "tray2"
    assert cut(of, 100) == [other.name]
    follow(of, alarm(2, 161.0))
    assert len(of.clips) == 3


def test_an_alarm_that_is_heard_late_joins_no_clip_that_is_being_cut():
    of = tracker()
    follow(of, alarm(0))
    (due,) = of.due(T0 + 62 * S)
    follow(of, alarm(1, 50.0))
    of.cut(CutResult(due.name, 100))
    assert [[each.fan for each in clip.alarms] for clip in of.clips] == [[0], [1]]
    assert [clip.is_due for clip in of.clips] == [False, True]


def test_a_fan_that_raises_alarms_for_ever_does_not_make_a_clip_without_an_end():
    of = tracker()
    follow(of, *(alarm(0, at_s) for at_s in range(0, 2000, 50)))
    assert all(clip.until_ns - clip.since_ns <= LONGEST_NS + 120 * S for clip in of.clips)
    assert 3 <= len(of.clips) <= 5
    assert len({clip.name for clip in of.clips}) == len(of.clips)


def test_what_is_known_silenced_or_no_raise_gives_no_clip():
    of = tracker()
    follow(of, alarm(0), alarm(0, 200.0, onset_s=0.0), alarm(1, 300.0, out_of_service=True))
    follow(of, alarm(2, 400.0, transition=Transition.REPUBLISHED), alarm(3, 500.0, transition=Transition.DIAGNOSED))
    assert len(of.clips) == 1


def test_a_clip_may_go_once_all_of_its_alarms_are_acknowledged_and_not_by_an_older_message():
    of = tracker(kept_s=60.0)
    follow(of, alarm(0), alarm(1, 10.0))
    cut(of, 80)
    of.follow(T0 + 131 * S)
    follow(of, alarm(0, 90.0, transition=Transition.ACKNOWLEDGED, acknowledged=True))
    follow(of, alarm(1, 5.0, transition=Transition.SHELVED, acknowledged=True))
    follow(of, alarm(1, 95.0, "tray2", transition=Transition.ACKNOWLEDGED, acknowledged=True))
    assert of.to_delete is None and of.beyond == of.clips
    follow(of, alarm(1, 95.0, transition=Transition.REPUBLISHED, acknowledged=True))
    assert of.to_delete == of.clips[0] and not of.beyond


def test_beyond_the_limit_acknowledged_clips_go_and_without_any_new_ones_are_not_kept():
    of = tracker(most_bytes=250)
    for number in range(3):
        follow(of, alarm(number, number * 200.0))
        cut(of, number * 200.0 + 70)
    assert of.to_delete is None
    follow(of, alarm(3, 600.0))
    assert cut(of, 670) == []
    assert of.counts["clips_not_kept"] == 1
    assert "acknowledge alarms" in of.problem()
    assert len(of.clips) == 3
    acknowledged = alarm(1, 700.0, transition=Transition.ACKNOWLEDGED, acknowledged=True)
    follow(of, acknowledged)
    clip = of.to_delete
    assert of.is_full and clip and clip.alarms[0].fan == 1
    of.deleted(clip)
    assert not of.is_full
    assert of.problem() == ""
    follow(of, alarm(4, 800.0))
    assert len(cut(of, 870)) == 1


def test_a_full_disk_is_reported_and_tried_again_and_what_is_gone_is_given_up():
    of = tracker()
    follow(of, alarm())
    assert cut(of, 70, 0, problem="the disk is full", may_pass=True)
    assert "the disk is full" in of.problem()
    assert cut(of, 75) == []
    assert cut(of, 81)
    assert of.problem() == ""
    follow(of, alarm(1, 100.0))
    cut(of, 170, 0, problem="nothing is there any more")
    assert "is not kept: nothing is there any more" in of.problem()
    assert not any(clip.is_due for clip in of.clips)


def test_a_clock_that_is_set_back_does_not_make_a_clip_wait():
    of = tracker()
    follow(of, alarm())
    assert of.due(T0 + 30 * S) == []
    (due,) = of.due(T0 - 3600 * S)
    assert due.until_ns == T0 + 30 * S


def test_only_clips_with_a_file_are_listed_and_damaged_lists_have_none(tmp_path: Path):
    of = tracker()
    follow(of, alarm(), alarm(1, 200.0), alarm(2, 400.0))
    cut(of, 470)
    (tmp_path / "recording.json").write_bytes(clips_as_text(of.clips))
    (tmp_path / "1-of-2.recording.json").write_text('{"clips": [{"name": 3}]}')
    for clip in of.clips[:2]:
        (tmp_path / clip.name).touch()
    assert [clip.alarms[0].fan for clip in kept_clips(tmp_path)] == [1, 0]
    assert kept_clips(tmp_path / "none") == []
    follow(other := tracker(), alarm(fan_name="CPU"))
    (named,) = other.clips
    assert clip_lines({"clip": json.dumps(named.about())})[0].startswith("alarm clip: tray1 CPU (fan 0), raised ")
    assert clip_lines({"clip": '{"tray": "tray1", "alarms": 3}'}) == ["alarm clip, whose metadata are damaged"]
