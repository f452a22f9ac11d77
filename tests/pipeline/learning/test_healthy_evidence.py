"""What operators have said of alarms decides what is healthy running."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from fantwin.pipeline.learning.healthy_evidence import marked_running
from fantwin.pipeline.replay.offline.alarm_episodes import LeftOut, alarms_in, concerning, marked_alarms
from fantwin.pipeline.replay.offline.healthy_runs import in_this_process
from fantwin.pipeline.site.alarm_history import AlarmHistory
from fantwin.schemas.enums import Action
from fantwin.schemas.units import NS_PER_S
from tests.support.healthy_site import FAULT_S, FAULTY_NS, with_alarm

ONSET_NS = FAULTY_NS + FAULT_S[0] * NS_PER_S
DAY_NS = 86_400 * NS_PER_S


def test_an_alarm_that_nobody_has_marked_leaves_nothing_out(tmp_path: Path) -> None:
    path = with_alarm(tmp_path / "alarms.mcap", None)
    found = marked_running([path], [], None, in_this_process)
    assert found.lines == ["1 alarm in the recordings is not marked as true or false: used as healthy running"]
    assert found.left_out == ()
    assert marked_running([path], [], "tray2", in_this_process).lines == []


def test_what_a_gateway_has_kept_counts_for_the_times_of_the_recordings(tmp_path: Path) -> None:
    recording = with_alarm(tmp_path / "alarms.mcap", None)
    store = AlarmHistory(tmp_path / "alarms.sqlite")
    alarms = [alarm for _, alarm in alarms_in(with_alarm(tmp_path / "marked.mcap", Action.TRUE_ALARM))]
    long_ago = [
        replace(each, header=replace(each.header, producer="s0"), t_ns=each.t_ns - DAY_NS, onset_t_ns=5 * NS_PER_S)
        for each in alarms[:2]
    ]
    for alarm in [*long_ago, *alarms]:
        store.add(alarm)
    store.close()
    found = marked_running([recording], [tmp_path / "alarms.sqlite"], None, in_this_process)
    (span,) = found.left_out
    assert (span.site, span.path, span.tray, span.fan) == ("plant", None, "tray1", 1)
    assert span.from_t_ns == ONSET_NS - 600 * NS_PER_S
    assert len(found.alarms) == 1, "that of long ago is of no recording here"


def test_a_stretch_is_left_out_only_in_its_own_tray_site_and_recording() -> None:
    span = LeftOut("a", None, "t1", 1, 0, 1)
    for more, is_meant in (
        *(({}, True), ({"site": ""}, True)),
        *(({"site": "b"}, False), ({"tray": "t2"}, False), ({"path": Path("x")}, False)),
    ):
        assert bool(concerning([replace(span, **more)], Path("r"), "a", "t1")) == is_meant, more


def test_where_times_are_no_dates_an_alarm_belongs_to_its_recording_alone(tmp_path: Path) -> None:
    alarms = alarms_in(with_alarm(tmp_path / "alarms.mcap", Action.TRUE_ALARM))
    undated = [
        (
            site,
            replace(
                alarm, t_ns=alarm.t_ns - FAULTY_NS, onset_t_ns=alarm.onset_t_ns - FAULTY_NS,
                marked_onset_t_ns=max(0, alarm.marked_onset_t_ns - FAULTY_NS),
            ),
        )
        for site, alarm in alarms
    ]  # fmt: skip
    paths = Path("one"), Path("two")
    found = marked_alarms([(path, undated) for path in paths])
    assert [span.path for each in found if (span := each.left_out)] == list(paths)
