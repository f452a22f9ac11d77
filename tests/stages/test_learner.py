"""stages.learner: when it learns, and from what; while fans have alarms, or may have one, no version takes over."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import pytest

from fantwin.pipeline.learning.healthy_history import KEPT_S, healthy_recordings
from fantwin.pipeline.learning.versions import Check
from fantwin.schemas.enums import Action, FanState
from fantwin.schemas.messages import NewTwin, Request
from fantwin.schemas.units import NS_PER_S
from tests.support.one_learner import START_NS, Learner, restarted


@pytest.fixture(autouse=True)
def _first_after_five_minutes(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in ("learner_core", "learning_schedule"):
        monkeypatch.setattr(f"fantwin.pipeline.learning.{module}.FIRST_S", 300.0)


def test_a_tray_that_moves_enough_says_when_its_first_version_is_due(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr("fantwin.pipeline.learning.learner_core.FIRST_S", 600.0)
    monkeypatch.setattr("fantwin.pipeline.learning.learning_schedule.FIRST_S", 600.0)
    learner = Learner(tmp_path)
    learner.run(400)
    waits = learner.core.learning()
    assert waits is not None
    assert (waits.fans[0].missing, waits.helps) == ("", "")
    assert waits.fans[0].progress == learner.history.seconds / 600.0
    due_s = (waits.until_t_ns - START_NS) / NS_PER_S
    assert abs(due_s - (learner.now_s + 600.0 - learner.history.seconds)) <= 1.0


def test_the_first_version_waits_for_enough_running_and_enough_movement(tmp_path: Path) -> None:
    learner = Learner(tmp_path)
    learner.run(600, moves=False)
    assert learner.learning.starts == []
    (note,) = learner.core.notes()
    assert note.startswith(
        "no twin yet, nothing is judged; 10 min recorded (5 needed); not moved enough yet: fan 0: command 0.5 so far,"
    )
    waits = learner.core.learning()
    assert waits is not None
    assert (waits.what, waits.until_t_ns, waits.fans[0].progress) == (
        "5 of 5 minutes recorded; the commands have not varied enough yet",
        0,
        0.0,
    ), "nobody knows when the fan will have moved enough"
    assert waits.helps == "`fantwin command --sweep` moves the fans"
    assert waits.fans[0].missing.startswith(
        "command 0.5 so far, still 20 s at each of 3 more levels and 10 more changes"
    )
    learner.run(600)
    assert learner.put_in_force == ["tray1-1"]
    assert learner.core.learning() is None
    (note,) = learner.core.notes()
    assert note == (
        "tray1-1 is in force; at 1,000 rpm it finds a drop of 40 rpm within a minute; declared: 1 false alarm per "
        "fan and day; next version after 10 min more of healthy running"
    )


def test_later_versions_come_when_the_history_has_doubled(tmp_path: Path) -> None:
    learner = Learner(tmp_path)
    learner.run(4000)
    made = [each.learned_s for each in learner.versions.all()]
    assert len(made) >= 3
    assert all(1.6 < after / before < 2.6 for before, after in pairwise(made)), made
    assert learner.put_in_force == [f"tray1-{number + 1}" for number in range(len(made))]


def test_an_offered_version_is_reported_and_put_in_force_only_by_the_operator(tmp_path: Path) -> None:
    learner = Learner(tmp_path)
    learner.run(600)
    learner.learning.outcome = "offered"
    learner.run(1500)
    assert set(learner.put_in_force) == {"tray1-1"}
    offered = learner.versions.all()[-1].name
    assert "next version" not in "; ".join(learner.core.notes()), "none is made before it is decided"
    assert learner.core.problem() == f"{offered} is offered: it is better (fantwin twins)"
    learner.versions.use(offered)
    learner.run(10)
    assert learner.put_in_force[-1] == offered
    assert learner.core.problem() == ""


def test_fans_that_were_commissioned_again_are_compared_with_the_twin_within_hours_also_after_a_restart(
    tmp_path: Path,
) -> None:
    learner = Learner(tmp_path)
    learner.run(3000)
    before = len(learner.versions.all())
    assert before > 1
    commissioned_t_ns = START_NS + learner.now_s * NS_PER_S
    learner.core.step(Request(t_ns=commissioned_t_ns, action=Action.COMMISSION))
    learner = restarted(learner)  # which must not forget it
    checks = len(learner.learning.checks)
    learner.run(3900)
    assert len(learner.learning.checks) == checks
    learner.run(1000)
    assert len(learner.learning.checks) == checks + 1, "after little more than an hour"
    learner.run(9_100)
    assert len(learner.versions.all()) == before
    learner.run(1000)
    assert len(learner.versions.all()) == before + 1
    last = learner.versions.all()[-1].learned_spans[-1]
    assert last[0] >= commissioned_t_ns, "the newest recording holds nothing from before"


@pytest.fixture
def checked_often(monkeypatch: pytest.MonkeyPatch) -> None:
    """After a thousand seconds, not a day."""
    monkeypatch.setattr("fantwin.pipeline.learning.learning_schedule.CHECK_AFTER_S", 1000.0)


@pytest.mark.usefixtures("checked_often")
def test_between_versions_the_fans_are_checked_against_the_reference_each_healthy_day(tmp_path: Path) -> None:
    learner = Learner(tmp_path)
    learner.run(10_000)
    versions = learner.versions.all()
    assert versions[-1].learned_s > 4000.0
    within = [checked_s for checked_s in learner.learning.checks if checked_s > versions[-1].learned_s]
    assert len(within) >= 3
    assert all(1000.0 <= after - before < 1200.0 for before, after in pairwise(within[:3])), within


def test_where_every_version_was_learned_from_a_faulty_time_another_is_made_at_once(tmp_path: Path) -> None:
    learner = Learner(tmp_path)
    learner.run(3000)
    before = learner.put_in_force[-1]
    learner.versions.mark_faulty((START_NS, START_NS + learner.now_s * NS_PER_S))
    learner.run(200, state=FanState.ALARM)
    assert learner.put_in_force[-1] == before, "there is too little else"
    learner.run(300, state=FanState.ALARM)
    assert learner.put_in_force[-1] != before, "alarms of such a twin do not keep it"
    assert not learner.versions.read().is_tainted


def test_while_the_list_of_versions_cannot_be_read_nothing_is_learned_and_the_reason_is_said(tmp_path: Path) -> None:
    learner = Learner(tmp_path)
    learner.run(600)
    made = len(learner.learning.starts)
    listed = tmp_path / "versions.json"
    content = listed.read_bytes()
    listed.write_bytes(b"{")
    learner.run(3000)
    assert len(learner.learning.starts) == made
    assert "cannot read the versions of the twin" in learner.core.problem()
    listed.write_bytes(content)
    learner.run(600)
    assert len(learner.learning.starts) > made
    assert learner.core.problem() == ""


@pytest.mark.usefixtures("checked_often")
def test_versions_and_checks_do_not_depend_on_one_another_and_what_failed_is_not_made_at_once_again(
    tmp_path: Path,
) -> None:
    learner = Learner(tmp_path)
    learner.learning.checks_fail_with = "a check failed"
    learner.run(8000)
    assert learner.core.problem() == "learning: a check failed"
    assert 0 < len(learner.learning.checks) < 15
    assert len(learner.learning.starts) >= 4
    until_t_ns = START_NS + learner.now_s * NS_PER_S
    learner.versions.add_check(Check(t_ns=until_t_ns, reference="", change=(), found="", spans=()))
    learner.run(10)
    assert learner.core.problem() == "", "somebody has made one"
    learner.learning.checks_fail_with, learner.learning.fails_with = "", "a failure"
    while not learner.core.problem():
        learner.run(10)
    before = len(learner.learning.checks)
    learner.run(3500)
    assert len(learner.learning.checks) >= before + 2
    assert learner.core.problem() == "learning: a failure"
    learner.learning.fails_with = ""
    while learner.core.problem():
        learner.run(100)
    assert learner.learning.starts, "it is tried again with more history"


def test_beside_an_alarm_nothing_is_learned_and_fans_are_checked_each_day(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fantwin.pipeline.learning.learning_schedule.CHECK_AFTER_S", 2 * 3600.0)
    learner = Learner(tmp_path)
    learner.run(600)
    before = len(learner.learning.starts)
    learner.run(5 * 3600, state=FanState.ALARM)
    first_h, second_h = ((t_ns - START_NS) / NS_PER_S / 3600.0 for t_ns in learner.learning.checked_t_ns)
    assert 2.0 < first_h < 2.5
    assert second_h - first_h == pytest.approx(2.0, abs=0.1)
    assert len(learner.learning.starts) == before
    assert all(each.span[1] < START_NS + 600 * NS_PER_S for each in healthy_recordings(tmp_path))


def test_no_version_takes_over_while_a_fan_may_have_an_alarm_unless_an_operator_chose_it(tmp_path: Path) -> None:
    learner = Learner(tmp_path)
    learner.run(600)
    seconds, made = learner.history.seconds, len(learner.learning.starts)
    assert learner.put_in_force == ["tray1-1"]
    learner.add_version("tray1-2")
    learner.run(100, state=FanState.ALARM)
    assert "no version takes over while fan 0 has an alarm" in learner.core.notes()
    for state in (FanState.UNKNOWN, FanState.STOPPED):  # which say nothing about it
        learner.run(1500, state=state)
    assert learner.put_in_force == ["tray1-1"]
    assert len(learner.learning.starts) == made
    assert all(each.span[1] < START_NS + 600 * NS_PER_S for each in healthy_recordings(tmp_path))
    learner.run(20)
    assert learner.put_in_force == ["tray1-1", "tray1-2"]
    learner.run(500, state=FanState.STOPPED)
    assert learner.history.seconds > seconds + 350.0, "samples of stopped fans are learned from"
    learner.add_version("tray1-3")
    learner.run(100, state=FanState.ALARM)
    assert learner.put_in_force == ["tray1-1", "tray1-2"]
    learner.versions.use("tray1-1")
    learner.versions.use("tray1-3")
    learner.run(100, state=FanState.ALARM)
    assert learner.put_in_force == ["tray1-1", "tray1-2", "tray1-3"]


def test_a_restarted_learner_publishes_the_version_before_while_a_fan_may_have_an_alarm(tmp_path: Path) -> None:
    first = Learner(tmp_path)
    first.run(600)
    assert first.versions.read().published == "tray1-1"
    first.run(20, state=FanState.ALARM)
    first.add_version("tray1-2")
    second = restarted(first)
    second.run(100, state=None)
    second.run(100, state=FanState.UNKNOWN)
    second.run(100, state=FanState.STOPPED)
    second.run(100, state=FanState.ALARM)
    assert second.put_in_force == ["tray1-1"]
    assert "tray1-2 waits: it takes over when no fan has an alarm, by the scores of all fans" in second.core.notes()
    second.run(20)
    assert second.put_in_force == ["tray1-1", "tray1-2"]
    assert second.versions.read().published == "tray1-2"


@pytest.mark.parametrize("because", ["an operator chose it", "the one before is gone"])
def test_a_restarted_learner_publishes_the_version_in_force_at_once(tmp_path: Path, because: str) -> None:
    first = Learner(tmp_path)
    first.run(600)
    first.run(20, state=FanState.ALARM)
    first.add_version("tray1-2")
    if because == "an operator chose it":
        first.versions.use("tray1-2")
    else:
        first.versions.file("tray1-1").unlink()
    second = restarted(first)
    second.run(10, state=None)
    assert second.put_in_force == ["tray1-2"]
    assert [each.content for each in second.emitted if isinstance(each, NewTwin)] == [b"tray1-2"]


def test_when_an_alarm_begins_its_time_is_listed(tmp_path: Path) -> None:
    learner = Learner(tmp_path)
    learner.run(600)
    learner.run(100, state=FanState.ALARM)
    learner.run(100, state=FanState.UNKNOWN)
    learner.run(100, state=FanState.RETURNING)
    learner.run(100)
    learner.run(100, state=FanState.ALARM)
    assert learner.versions.read().alarms_t_ns == tuple(START_NS + second * NS_PER_S for second in (600, 1000))
    learner.run(10)
    learner.now_s += round(KEPT_S)
    learner.run(10, state=FanState.ALARM)
    listed = learner.versions.read().alarms_t_ns
    assert listed[-1] == START_NS + (1110 + round(KEPT_S)) * NS_PER_S
    assert len(listed) == 3, "no recording of the time of the others has been deleted yet"
