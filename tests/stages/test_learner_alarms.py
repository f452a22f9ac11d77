"""stages.learner: while fans have alarms, or may have one, nothing is learned and no version takes over."""

from __future__ import annotations

from pathlib import Path

import pytest

from fantwin.pipeline.learning.healthy_history import healthy_recordings
from fantwin.schemas.enums import FanState
from fantwin.schemas.messages import NewTwin
from fantwin.schemas.units import NS_PER_S
from fantwin.stages.learner import LearnerConfig
from tests.support.one_learner import START_NS, Learner, restarted


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


def test_a_version_waits_for_the_end_of_an_alarm_unless_an_operator_chose_it(tmp_path: Path) -> None:
    learner = Learner(tmp_path)
    learner.run(600)
    assert learner.put_in_force == ["tray1-1"]
    learner.add_version("tray1-2")
    learner.run(100, state=FanState.ALARM)
    assert learner.put_in_force == ["tray1-1"]
    assert "no version takes over while fan 0 has an alarm" in learner.core.notes()
    learner.versions.use("tray1-1")
    learner.versions.use("tray1-2")
    learner.run(100, state=FanState.ALARM)
    assert learner.put_in_force == ["tray1-1", "tray1-2"]
    learner.add_version("tray1-3")
    learner.run(100, state=FanState.ALARM)
    learner.run(20)
    assert learner.put_in_force == ["tray1-1", "tray1-2", "tray1-3"]


def test_an_alarm_is_not_forgotten_while_scores_say_nothing_about_it(tmp_path: Path) -> None:
    learner = Learner(tmp_path)
    learner.run(600)
    seconds, made = learner.history.seconds, len(learner.learning.starts)
    learner.run(100, state=FanState.ALARM)
    began_t_ns = START_NS + 600 * NS_PER_S
    learner.add_version("tray1-2")
    for state in (FanState.UNKNOWN, FanState.STOPPED):
        learner.run(1500, state=state)
    assert learner.put_in_force == ["tray1-1"]
    assert len(learner.learning.starts) == made
    assert all(each.span[1] < began_t_ns for each in healthy_recordings(tmp_path))
    learner.run(20)
    assert learner.put_in_force == ["tray1-1", "tray1-2"]
    learner.run(500, state=FanState.STOPPED)
    assert learner.history.seconds > seconds + 350.0, "samples of stopped fans are learned from"


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
    kept_s = round(3600 * LearnerConfig().kept_hours)
    learner.now_s += kept_s
    learner.run(10, state=FanState.ALARM)
    listed = learner.versions.read().alarms_t_ns
    assert listed[-1] == START_NS + (1110 + kept_s) * NS_PER_S
    assert len(listed) == 3, "no recording of the time of the others has been deleted yet"
