"""stages.learner: an operator's request moves the fans, once, soon and only where it may; its end is one line."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Sequence
from pathlib import Path

import pytest

from fantwin.pipeline.learning.child_command import ChildCommand
from fantwin.pipeline.learning.learner_core import LearnerCore
from fantwin.pipeline.learning.requested_sweep import RequestedSweep, plan_of
from fantwin.pipeline.learning.sweep_steps import FANS_KEEP
from fantwin.schemas.enums import Action
from fantwin.schemas.health import Sweep
from fantwin.schemas.messages import Request
from fantwin.schemas.units import NS_PER_S
from tests.support.one_learner import START_NS, TRAY, Learner
from tests.support.running_chain import eventually


class FakeChild(ChildCommand):
    """A sweep that says and does what the test wants."""

    def __init__(self, turn: threading.Lock, log: Path) -> None:
        super().__init__(turn, log)
        self.begun: list[Sequence[str]] = []
        self.says, self.asked = "", 0
        self.status: int | None = None

    @property
    def seconds(self) -> float | None:
        return 1.0 if self._turn.locked() else None

    @property
    def last_line(self) -> str:
        return self.says

    def begin(self, words: Sequence[str]) -> str:
        self.begun.append(words)
        self._turn.acquire()
        self.says, self.status = "", None
        return ""

    def ended(self) -> int | None:
        status, self.status = self.status, None
        if status is not None:
            self._turn.release()
        return status

    def ask_to_end(self) -> None:
        self.asked += 1

    def end(self, within_s: float) -> bool:
        self.asked += 1
        return True


class Swept(Learner):
    """A learner that operators may ask."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.turn, self.is_replayed = threading.Lock(), False
        self.child = FakeChild(self.turn, folder / "sweep.log")
        sweep = RequestedSweep(TRAY, ["-c", "fantwin.toml", "--tray", "tray1"], self.child)
        parts = (self.history, self.versions, self.core._operation, self.learning)
        self.core = LearnerCore(1, *parts, sweep, lambda: self.is_replayed)
        self.run(10, moves=False)

    def ask(self, action: Action, late_s: int = 0) -> Sweep:
        t_ns = START_NS + (self.now_s - late_s) * NS_PER_S
        self.core.step(Request(t_ns=t_ns, action=action, operator_name="ann"))
        waits = self.core.learning()
        assert waits and waits.sweep and waits.sweep.asked_t_ns == t_ns
        return waits.sweep

    def end_with(self, line: str, status: int) -> None:
        self.child.says, self.child.status = line, status
        self.run(10, moves=False)


def test_a_request_begins_one_sweep_whose_steps_are_shown_and_a_second_request_begins_no_other(tmp_path: Path) -> None:
    learner = Swept(tmp_path)
    begun = learner.ask(Action.SWEEP)
    assert begun.running == "it begins"
    assert learner.child.begun == [["command", "--sweep", "--rounds", "2", "-c", "fantwin.toml", "--tray", "tray1"]]
    learner.child.says = "step 5 of 46: command 0.2 for 1.0 s, 120 s left"
    assert learner.ask(Action.SWEEP).running == learner.child.says
    assert len(learner.child.begun) == 1
    assert learner.core.notes()[-1] == f"the fans are moved, as ann has asked: {learner.child.says}"
    learner.run(1200)
    assert not learner.learning.starts, "no twin is made of half a sweep"
    learner.ask(Action.STOP_SWEEP)
    assert learner.child.asked == 1
    learner.end_with("stopped; the fans are left at these commands: fan 0 0.4", 1)
    waits = learner.core.learning()
    assert waits is None or waits.sweep
    assert learner.core.problem() == ""
    learner.run(10)
    assert learner.learning.starts, "the sweep is over"


@pytest.mark.parametrize(
    ("line", "status", "is_problem"),
    [
        ("the sweep has ended: fan 0 has command 0.4 and not 1: something else sets it; stop that", 1, False),
        (f"{FANS_KEEP}; send these by hand: fan 0 0.4 (no acquisition)", 1, True),
        ("step 5 of 46: command 0.2", -signal.SIGKILL, True),
    ],
)
def test_why_a_sweep_has_failed_is_one_line_and_fans_that_keep_its_command_are_a_problem(
    tmp_path: Path, line: str, status: int, is_problem: bool
) -> None:
    learner = Swept(tmp_path)
    learner.ask(Action.SWEEP)
    learner.end_with(line, status)
    waits = learner.core.learning()
    assert waits and waits.sweep and not waits.sweep.running
    expected = line if status > 0 else f"the sweep was ended by signal 9: {FANS_KEEP}; send others by hand"
    assert waits.sweep.ended == expected
    assert learner.core.problem() == (expected if is_problem else "")
    assert (expected in learner.core.notes()) is not is_problem
    assert learner.ask(Action.SWEEP).ended == "", "another one begins"


def test_what_may_not_be_begun_is_refused_with_the_reason(tmp_path: Path) -> None:
    learner = Swept(tmp_path)

    def refused(late_s: int = 0) -> str:
        now = learner.ask(Action.SWEEP, late_s)
        assert (now.running, learner.child.begun) == ("", [])
        return now.ended.removeprefix("the sweep was not begun: ")

    assert refused(late_s=3600) == "the request is 3600 s old: set the hosts' clocks"
    learner.is_replayed = True
    assert refused() == "a replay presents the tray"
    learner.is_replayed = False
    learner.learning._is_working = True
    assert refused() == "the first twin is being made"


def test_a_sweep_ends_with_its_learner_and_when_there_is_a_twin(tmp_path: Path) -> None:
    learner = Swept(tmp_path)
    learner.ask(Action.SWEEP)
    learner.core.close()
    assert learner.child.asked == 1
    other = Swept(tmp_path / "other")
    other.ask(Action.SWEEP)
    other.add_version("tray1-1")
    other.run(10)
    assert other.child.asked == 1


def test_the_plan_names_the_fans_their_commands_and_how_long_it_takes() -> None:
    tray = TRAY.model_copy(update={"command_max": 255.0})
    assert plan_of(tray) == (
        "fan 0 of tray1: commands from 51 to 255, 20% to 100% of its range, up and down, in steps as long as the fans "
        "need: 1 to 49 minutes in all. Nothing else may set their commands meanwhile. At the end, also when it is "
        "stopped, each fan gets the command that it had before."
    )


def test_one_child_runs_at_a_time_its_last_line_is_read_and_it_stops_when_the_stage_lets_go(
    tmp_path: Path, monkeypatch
):
    script = tmp_path / "fantwin"
    script.write_text("#!/bin/sh\necho first\nprintf 'fantwin: second\\nthi'\nread line\necho rd\nexit 4\n")
    script.chmod(0o755)
    monkeypatch.setattr(sys, "executable", os.fspath(script))
    turn = threading.Lock()
    child, other = (ChildCommand(turn, tmp_path / name) for name in ("a.log", "b.log"))
    assert child.begin([]) == "" and not other.is_free
    assert other.begin([]) == "another one runs"
    eventually(lambda: child.last_line == "second", "whole lines are read")
    assert child.ended() is None
    assert child._child and child._child.stdin
    child._child.stdin.close()  # as at the end of this process
    assert eventually(lambda: child.ended() == 4, "it ends")
    assert (child.last_line, child.seconds, other.is_free) == ("third", None, True)
