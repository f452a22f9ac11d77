"""`fantwin twins learn` as a child process that runs while nothing else does, one at a time in this process."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path

_TURN = threading.Lock()
"""one tray learns at a time, to limit memory and processor use"""
STOP_S = 2.0
VARIABLE = "FANTWIN_LEARNS_FOR_A_STAGE"
"""environment variable of the child: it gives way to all else, and ends with its parent, which holds its standard
input open"""


class LearningProcess:
    """The command for one tray of a configuration."""

    def __init__(self, config: Path, overrides: Sequence[str], tray: str, log: Path) -> None:
        """log: file for the standard error of the last run."""
        sets = [word for override in overrides for word in ("--set", override)]
        self._fantwin = [sys.executable, "-P", "-m", "fantwin", "twins"]
        self._options = ["-c", str(config), "--tray", tray, *sets]
        self._log = log
        self._child: subprocess.Popen[bytes] | None = None
        self._began_s = 0.0

    @property
    def is_free(self) -> bool:
        """Whether no tray of this process is learning."""
        return not _TURN.locked()

    def start(self, *, only_if_changed: bool) -> str:
        """Begin, if it is free; returns what went wrong, or nothing. only_if_changed: see `fantwin twins check`."""
        if not _TURN.acquire(blocking=False):
            return "another tray is learning"
        try:
            self._log.parent.mkdir(parents=True, exist_ok=True)
            with self._log.open("wb") as log:
                self._child = subprocess.Popen(
                    [*self._fantwin, "check" if only_if_changed else "learn", *self._options],
                    stdin=subprocess.PIPE,
                    stdout=subprocess.DEVNULL,
                    stderr=log,
                    env={**os.environ, "OMP_NUM_THREADS": "1", VARIABLE: "1"},
                )
        except OSError as error:
            _TURN.release()
            return f"learning could not be started: {error.strerror}"
        self._began_s = time.monotonic()
        return ""

    def poll(self) -> str | None:
        """None while it works; then, once, what went wrong, or an empty string."""
        if self._child is None or self._child.poll() is None:
            return None
        status = self._child.returncode
        self._release()
        if not status:
            return ""
        lines = self._log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
        return lines[-1].removeprefix("fantwin: ") if lines else f"`fantwin twins learn` ended with status {status}"

    @property
    def seconds(self) -> float | None:
        """How long it has been working; None: it is not."""
        return None if self._child is None else time.monotonic() - self._began_s

    def stop(self) -> None:
        """End it; no version is made."""
        if self._child is None:
            return
        self._child.terminate()
        try:
            self._child.wait(STOP_S)
        except subprocess.TimeoutExpired:
            self._child.kill()
            self._child.wait()
        self._release()

    def _release(self) -> None:
        if self._child and self._child.stdin:
            self._child.stdin.close()
        self._child = None
        _TURN.release()
