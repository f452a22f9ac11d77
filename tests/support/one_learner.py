"""A learner with a tray of one fan and a substitute for `fantwin twins learn`, and what it is fed."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from fantwin.pipeline.config.settings import TrayConfig
from fantwin.pipeline.learning.healthy_history import HealthyHistory, healthy_recordings, recordings_near_alarms
from fantwin.pipeline.learning.learner_core import LearnerCore
from fantwin.pipeline.learning.learning_schedule import LearningProcess
from fantwin.pipeline.learning.ordinary_operation import OrdinaryOperation
from fantwin.pipeline.learning.versions import Check, TwinVersions
from fantwin.schemas.enums import FanState
from fantwin.schemas.messages import Message, NewTwin, Raw, Score
from fantwin.schemas.units import NS_PER_S
from tests.support.learned_versions import version
from tests.support.made_messages import filled

START_NS = 1_800_000_000 * NS_PER_S
TRAY = TrayConfig.model_validate({"name": "tray1", "fans": 1})


class FakeLearning(LearningProcess):
    """Makes a version at the next poll, or fails."""

    def __init__(self, versions: TwinVersions) -> None:
        self.versions = versions
        self.fails_with = ""
        self.checks_fail_with = ""
        self.outcome = "taken"
        self.starts: list[int] = []
        """how many recordings there were"""
        self.checks: list[float] = []
        """how much healthy running there was"""
        self.checked_t_ns: list[int] = []
        """up to when"""
        self._is_working = False

    def start(self, *, only_if_changed: bool) -> str:
        found = healthy_recordings(self.versions.folder, self.versions.read().excluded_spans)
        if only_if_changed:
            self.checks.append(sum(each.seconds for each in found))
            if self.checks_fail_with:
                return self.checks_fail_with
            everything = (*found, *recordings_near_alarms(self.versions.folder))
            self.checked_t_ns.append(max(each.span[1] for each in everything))
            near_t_ns = everything[-1].span[1]
            check = Check(t_ns=found[-1].span[1], reference="", change=(), found="", spans=(), near_t_ns=near_t_ns)
            self.versions.add_check(check)
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
        found = healthy_recordings(self.versions.folder, self.versions.read().excluded_spans)
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
        self.core = LearnerCore(1, self.history, self.versions, OrdinaryOperation(TRAY), self.learning)
        self.now_s = 0
        self.emitted: list[Message] = []

    def run(self, seconds: int, *, moves: bool = True, state: FanState | None = FanState.NORMAL) -> None:
        """state: of the fan in all scores; None: no scores."""
        for _ in range(0, seconds, 10):
            if state is not None:
                self.core.step(score(self.now_s, state))
            self.core.step(raw(self.now_s, moves=moves))
            self.now_s += 10
            self.emitted += self.core.tick(START_NS + self.now_s * NS_PER_S)

    def add_version(self, name: str) -> None:
        """One that was taken."""
        self.versions.folder.mkdir(parents=True, exist_ok=True)
        self.versions.file(name).write_bytes(name.encode())
        self.versions.add(version(name, 2))

    @property
    def put_in_force(self) -> list[str]:
        return [message.twin for message in self.emitted if isinstance(message, NewTwin)]


def raw(second: int, *, moves: bool) -> Raw:
    level = (second // 30) % 5 * 0.2 + 0.1 if moves else 0.5
    t_ns = START_NS + (second + np.arange(10)) * NS_PER_S
    return filled(Raw, 10, 1, host_receive_t_ns=t_ns, command=level, speed_rad_s=100.0)


def score(second: int, state: FanState) -> Score:
    return filled(Score, 1, 1, period_ns=NS_PER_S, t_ns=START_NS + second * NS_PER_S, state=state, valid=False)


def restarted(first: Learner) -> Learner:
    first.core.close()
    second = Learner(first.folder)
    second.now_s = first.now_s
    return second
