"""Processes of stages that cannot be started: nothing is left of them, and the reason is said."""

from __future__ import annotations

import errno
import os
import subprocess
import threading
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from fantwin.pipeline.config.loading import load_config
from fantwin.pipeline.config.shards import Shard, StageProcess
from fantwin.pipeline.launch.launcher import Launcher
from fantwin.pipeline.launch.processes import EXIT_CANNOT_START, Child, Notices
from tests.support.running_chain import DEMO


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
