"""stages.learner: when it learns, from what, and what it puts in force."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from pipeline.config.models import TrayConfig
from pipeline.learning.healthy_history import HealthyHistory, healthy_recordings
from pipeline.learning.ordinary_operation import OrdinaryOperation
from pipeline.learning.versions import Check, TwinVersions
from schemas.messages import Action, FanState, Message, NewTwin, Raw, Request, Score
from schemas.units import NS_PER_S
from stages.learner import LearnerConfig, LearnerCore
from tests.pipeline.learning.test_versions import version

START_NS = 1_800_000_000 * NS_PER_S
TRAY = TrayConfig.model_validate({"name": "tray1", "fans": 1})


class FakeLearning:
    """Makes a version at the next poll, or fails."""

    def __init__(self, versions: TwinVersions) -> None:
        self.versions = versions
        self.fails_with = ""
        self.outcome = "taken"
        self.starts: list[int] = []
        """how many recordings there were"""
        self.checks: list[float] = []
        """how much healthy running there was"""
        self._is_working = False

    def start(self, *, only_if_changed: bool) -> str:
        found = healthy_recordings(self.versions.folder)
        if only_if_changed:
            self.checks.append(sum(each.seconds for each in found))
            self.versions.add_check(Check(t_ns=found[-1].span[1], reference="", change=(), found="", spans=()))
            return ""
        self.starts.append(len(found))
        self._is_working = True
        return ""

    def poll(self) -> str | None:
        if not self._is_working:
            return None
        self._is_working = False
        if self.fails_with:
            return self.fails_with
        found = healthy_recordings(self.versions.folder)
        name = self.versions.next_name()
        self.versions.folder.mkdir(parents=True, exist_ok=True)
        self.versions.file(name).write_bytes(name.encode())
        made = version(name, 2, made_t_ns=found[-1].span[1], learned_spans=tuple(each.span for each in found))
        if self.outcome == "offered":
            spans = tuple(each.span for each in found[-1:])
            self.versions.add_check(
                Check(t_ns=made.made_t_ns, reference="tray1-1", change=(0.1,), found="changed", spans=spans)
            )
        self.versions.add(made.model_copy(update={"outcome": self.outcome}))
        return ""

    @property
    def is_free(self) -> bool:
        return not self._is_working

    @property
    def seconds(self) -> float | None:
        return 1.0 if self._is_working else None

    def stop(self) -> None:
        self._is_working = False


class Learner:
    """A learner, and the seconds that its tray has run."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.versions = TwinVersions(folder, "tray1")
        self.learning = FakeLearning(self.versions)
        self.history = HealthyHistory(folder, "site", "tray1", {}, {}, hold_back_s=60.0, kept_s=1e6)
        self.core = LearnerCore(
            1, LearnerConfig(first_minutes=5.0), self.history, self.versions, OrdinaryOperation(TRAY), self.learning
        )
        self.now_s = 0
        self.emitted: list[Message] = []

    def run(self, seconds: int, *, moves: bool = True, state: FanState = FanState.NORMAL) -> None:
        for _ in range(0, seconds, 10):
            self.core.step(score(self.now_s, state))
            self.core.step(raw(self.now_s, moves=moves))
            self.now_s += 10
            self.emitted += self.core.tick(START_NS + self.now_s * NS_PER_S)

    @property
    def put_in_force(self) -> list[str]:
        return [message.twin for message in self.emitted if isinstance(message, NewTwin)]


def raw(second: int, *, moves: bool) -> Raw:
    level = (second // 30) % 5 * 0.2 + 0.1 if moves else 0.5
    return Raw(
        fans=1,
        host_receive_t_ns=START_NS + (second + np.arange(10, dtype=np.int64)) * NS_PER_S,
        command=np.full((10, 1), level),
        speed_rad_s=np.full((10, 1), 100.0),
    )


def score(second: int, state: FanState) -> Score:
    one = np.zeros((1, 1))
    arrays = ("command", "measured_speed_rad_s", "predicted_speed_rad_s", "lower_bound_rad_s", "upper_bound_rad_s")
    more = ("band_variance", "residual_rad_s", "smoothed_residual_rad_s")
    return Score(
        fans=1,
        period_ns=NS_PER_S,
        t_ns=np.array([START_NS + second * NS_PER_S]),
        outside=one.astype(bool),
        state=np.full((1, 1), int(state), np.uint8),
        valid=one.astype(bool),
        invalid_reason=one.astype(np.uint8),
        **dict.fromkeys((*arrays, *more), one),
    )


def test_the_first_version_waits_for_enough_running_and_enough_movement(tmp_path: Path) -> None:
    learner = Learner(tmp_path)
    learner.run(600, moves=False)
    assert learner.learning.starts == []
    (note,) = learner.core.notes()
    assert note.startswith(
        "no twin yet, nothing is judged; 10 min recorded (5 needed); not moved enough yet: fan 0: command 0.5,"
    )
    learner.run(600)
    assert learner.put_in_force == ["tray1-1"]
    (note,) = learner.core.notes()
    assert note == (
        "tray1-1 is in force; at 1,000 rpm it finds a drop of 40 rpm within a minute; declared: 1 false alarm per "
        "fan and day"
    )


def test_later_versions_come_when_the_history_has_doubled(tmp_path: Path) -> None:
    learner = Learner(tmp_path)
    learner.run(5000)
    made = [each.learned_s for each in learner.versions.all()]
    assert len(made) >= 4
    assert all(1.6 < after / before < 2.6 for before, after in pairwise(made)), made
    assert learner.put_in_force == [f"tray1-{number + 1}" for number in range(len(made))]


def test_nothing_is_learned_beside_an_alarm(tmp_path: Path) -> None:
    learner = Learner(tmp_path)
    learner.run(600)
    before = len(learner.learning.starts)
    learner.run(3000, state=FanState.ALARM)
    assert len(learner.learning.starts) == before
    assert all(each.span[1] < START_NS + 600 * NS_PER_S for each in healthy_recordings(tmp_path))


def test_what_failed_is_said_and_tried_again_with_more_history(tmp_path: Path) -> None:
    learner = Learner(tmp_path)
    learner.learning.fails_with = "too little for any limit"
    learner.run(330)
    assert learner.core.problem() == "learning: too little for any limit"
    assert len(learner.learning.starts) == 1
    learner.learning.fails_with = ""
    learner.run(400)
    assert learner.put_in_force[:1] == ["tray1-1"]
    assert learner.core.problem() == ""


def test_an_offered_version_is_reported_and_put_in_force_only_by_the_operator(tmp_path: Path) -> None:
    learner = Learner(tmp_path)
    learner.run(600)
    learner.learning.outcome = "offered"
    learner.run(1500)
    assert set(learner.put_in_force) == {"tray1-1"}
    offered = learner.versions.all()[-1].name
    assert learner.core.problem() == f"{offered} is offered: it is better (fantwin twins)"
    learner.versions.use(offered)
    learner.run(10)
    assert learner.put_in_force[-1] == offered
    assert learner.core.problem() == ""


def test_after_fans_are_commissioned_again_the_twin_is_compared_with_them_within_hours(tmp_path: Path) -> None:
    learner = Learner(tmp_path)
    learner.run(3000)
    before = len(learner.versions.all())
    assert before > 1
    commissioned_t_ns = START_NS + learner.now_s * NS_PER_S
    learner.core.step(Request(t_ns=commissioned_t_ns, action=Action.COMMISSION))
    learner.run(14_000)
    assert len(learner.versions.all()) == before
    learner.run(1000)
    assert len(learner.versions.all()) == before + 1
    last = learner.versions.all()[-1].learned_spans[-1]
    assert last[0] >= commissioned_t_ns, "the newest recording holds nothing from before"


def test_that_fans_were_commissioned_again_is_not_forgotten_by_a_restart(tmp_path: Path) -> None:
    first = Learner(tmp_path)
    first.run(3000)
    first.core.step(Request(t_ns=START_NS + first.now_s * NS_PER_S, action=Action.COMMISSION))
    first.core.close()
    before = len(first.versions.all())
    second = Learner(tmp_path)
    second.now_s = first.now_s
    second.run(15_500)
    assert len(second.versions.all()) == before + 1


def test_between_versions_the_fans_are_checked_against_the_reference_each_healthy_day(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("stages.learner.CHECK_AFTER_S", 1000.0)
    learner = Learner(tmp_path)
    learner.run(10_000)
    versions = learner.versions.all()
    assert versions[-1].learned_s > 4000.0
    within = [checked_s for checked_s in learner.learning.checks if checked_s > versions[-2].learned_s]
    assert len(within) >= 3
    assert all(1000.0 <= after - before < 1200.0 for before, after in pairwise(within[:3])), within


def test_a_restarted_learner_publishes_the_version_in_force_at_once(tmp_path: Path) -> None:
    first = Learner(tmp_path)
    first.run(600)
    first.core.close()
    second = Learner(tmp_path)
    second.emitted += second.core.tick(START_NS)
    (message,) = second.emitted
    assert isinstance(message, NewTwin)
    assert (message.twin, message.content) == ("tray1-1", b"tray1-1")


def test_samples_of_another_number_of_fans_are_left_alone(tmp_path: Path) -> None:
    learner = Learner(tmp_path)
    one = raw(0, moves=True)
    two = replace(one, fans=2, command=np.tile(one.command, 2), speed_rad_s=np.tile(one.speed_rad_s, 2))
    results: Sequence[Message] = learner.core.step(two)
    assert results == []
    assert learner.history.seconds == 0.0


def test_a_version_waits_for_the_end_of_an_alarm_unless_an_operator_chose_it(tmp_path: Path) -> None:
    learner = Learner(tmp_path)
    learner.run(600)
    assert learner.put_in_force == ["tray1-1"]
    learner.versions.add(version("tray1-2", 2))
    learner.versions.file("tray1-2").write_bytes(b"tray1-2")
    learner.run(100, state=FanState.ALARM)
    assert learner.put_in_force == ["tray1-1"]
    learner.versions.use("tray1-1")
    learner.versions.use("tray1-2")
    learner.run(100, state=FanState.ALARM)
    assert learner.put_in_force == ["tray1-1", "tray1-2"]
    learner.versions.add(version("tray1-3", 2))
    learner.versions.file("tray1-3").write_bytes(b"tray1-3")
    learner.run(100, state=FanState.ALARM)
    learner.run(20)
    assert learner.put_in_force == ["tray1-1", "tray1-2", "tray1-3"]


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
