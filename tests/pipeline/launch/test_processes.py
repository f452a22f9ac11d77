"""Processes of stages: one that hangs is found by its silence; of one that cannot be started nothing is left."""

from __future__ import annotations

import errno
import os
import subprocess
import threading
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from fantwin.pipeline.config.loading import load_config
from fantwin.pipeline.config.shards import Shard, StageProcess
from fantwin.pipeline.launch.launcher import Launcher
from fantwin.pipeline.launch.processes import EXIT_CANNOT_START, Child, HangDetector, Notices
from fantwin.pipeline.runtime.service_manager import SignsOfLife, starting
from fantwin.pipeline.site.stage_states import START_LIMIT_S
from tests.support.running_chain import DEMO, eventually

LIMIT_S = 10.0


@dataclass
class Process:
    name: str
    heard_s: float = 0.0
    is_ready: bool = True


class Site:
    """A detector that is asked every tenth of a second about processes that are at work until they hang."""

    def __init__(self, *names: str) -> None:
        self.detector = HangDetector(LIMIT_S)
        self.now_s = 0.0
        self.hangs: set[str] = set()
        self.running = [Process(name) for name in names]

    def hung_within(self, seconds: float) -> str:
        """The name of the first process that hangs, which is then killed; empty if none does."""
        until_s = self.now_s + seconds
        while self.now_s < until_s:
            self.now_s += 0.1
            for process in self.running:
                if process.name not in self.hangs:
                    process.heard_s = self.now_s
            if hung := self.detector.hung(self.running, self.now_s):
                self.running.remove(hung)
                return hung.name
        return ""


def test_row_01_a_stage_that_hangs_is_named_when_its_time_is_over_and_those_that_it_blocks_are_not():
    site = Site("acquisition", "resampler", "scorer")
    assert not site.hung_within(20.0)
    for name in ("scorer", "resampler", "acquisition"):  # each blocks the one before it half a second later
        site.hangs.add(name)
        site.hung_within(0.5)
    assert not site.hung_within(7.5)
    assert site.hung_within(2.0) == "scorer"
    assert not site.hung_within(9.0), "the others are given a new period"
    site.hangs.clear()
    assert not site.hung_within(20.0)


def test_row_01_when_the_launcher_itself_did_not_run_no_stage_is_blamed():
    site = Site("scorer")
    site.hung_within(1.0)
    site.now_s += 3600.0
    assert site.detector.hung(site.running, site.now_s) is None
    assert not site.hung_within(20.0)


def test_a_stage_that_starts_is_given_longer():
    detector, starting_one = HangDetector(LIMIT_S), Process("scorer", is_ready=False)
    seconds = [second for second in range(200) if detector.hung([starting_one], float(second))]
    assert seconds[0] == pytest.approx(START_LIMIT_S, abs=2.0)


def test_notices_follow_the_protocol_of_systemd():
    notices = Notices()
    notifier = SignsOfLife(notices.address)
    assert not notices.read()
    notifier.at_work("starting")
    assert notices.read()
    assert (notices.is_ready, notices.status) == (False, "starting")
    notifier.ready()
    notifier.at_work("ok:\nall is well")
    assert notices.read()
    assert (notices.is_ready, notices.status) == (True, "ok: all is well")
    notices.close()
    notifier.stopping()  # nobody listens any more


def test_row_01_a_stage_that_is_built_for_long_says_that_it_is_at_work(monkeypatch):
    """The recorder repairs a large recording, or the router is not there yet."""
    notices = Notices()
    monkeypatch.setenv("NOTIFY_SOCKET", notices.address)
    with starting():
        eventually(notices.read, "a notice while it is built")
    assert (notices.is_ready, notices.status) == (False, "starting")
    with starting(limit_s=0.0):
        pass
    assert not notices.read(), "what takes too long hangs"
    notices.close()


def test_a_launcher_that_reads_nothing_does_not_block_a_stage():
    notices = Notices()
    notifier = SignsOfLife(notices.address)
    for _ in range(2000):
        notifier.ready()
        notifier.at_work("ok")
    assert notices.read()
    notices.close()


class Started:
    """A process that runs until it is killed."""

    def __init__(self) -> None:
        self.called: list[str] = []

    def kill(self) -> None:
        self.called.append("kill")

    def wait(self) -> None:
        self.called.append("wait")


@pytest.mark.parametrize(("fails", "called"), [("Popen", []), ("Thread", ["kill", "wait"])])
def test_of_a_process_that_could_not_be_started_nothing_is_left(
    monkeypatch: pytest.MonkeyPatch, fails: str, called: list[str]
) -> None:
    """It would go on without a launcher, with the line of its tray."""
    process, closed = Started(), list[bool]()

    def start(*_arguments: object, **_more: object) -> Started:
        if fails == "Popen":
            raise OSError(errno.ENOMEM, os.strerror(errno.ENOMEM))
        return process

    def start_thread(_thread: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(subprocess, "Popen", start)
    monkeypatch.setattr(threading.Thread, "start", start_thread)
    monkeypatch.setattr(Notices, "close", lambda _notices: closed.append(True))
    with pytest.raises(OSError, match="Cannot allocate memory|Resource temporarily unavailable"):
        Child(StageProcess("recorder", Shard("all", (), ())), Path("fantwin.toml"), (), lambda _row, _line: None, 0)
    assert (len(closed), process.called) == (1, called)


def test_why_a_stage_cannot_start_again_is_in_the_line_that_says_so() -> None:
    said: list[str] = []
    launcher = Launcher(load_config(DEMO / "demo.toml"), (), said.append)
    slot = next(slot for slot in launcher._slots if slot.row.label == "scorer")
    notices = SimpleNamespace(close=lambda: None)
    ended = SimpleNamespace(started_s=0.0, last_line="scorer.pem: expired", notices=notices, stop=lambda _timeout_s: 0)
    slot.child, slot.delay_s = cast("Any", ended), 1.0
    launcher._plan_restart(slot, EXIT_CANNOT_START, 5.0)
    assert said == ["scorer: cannot start: scorer.pem: expired, restarting in 1.0 s"]
