"""A command of fantwin as a child process of a stage: it ends with the stage, in whatever way that ends."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path

VARIABLE = "FANTWIN_RUNS_FOR_A_STAGE"
"""environment variable of the child: it stops when its standard input ends, which the stage holds open"""
_TAIL_BYTES = 4096


class ChildCommand:
    """One command at a time of all that take the same turn in this process."""

    def __init__(self, turn: threading.Lock, log: Path) -> None:
        """log: file for what the last one has said."""
        self._turn = turn
        self._log = log
        self._child: subprocess.Popen[bytes] | None = None
        self._began_s = 0.0
        self._is_asked_to_end = False

    @property
    def is_free(self) -> bool:
        """Whether none runs."""
        return not self._turn.locked()

    @property
    def seconds(self) -> float | None:
        """How long this one has run; None: it does not."""
        return None if self._child is None else time.monotonic() - self._began_s

    def begin(self, words: Sequence[str]) -> str:
        """Begin `fantwin` with these words, if no other runs; returns what the system has against it, or nothing."""
        if not self._turn.acquire(blocking=False):
            return "another one runs"
        try:
            self._log.parent.mkdir(parents=True, exist_ok=True)
            with self._log.open("wb") as log:
                self._child = subprocess.Popen(
                    [sys.executable, "-P", "-m", "fantwin", *words],
                    stdin=subprocess.PIPE,
                    stdout=log,
                    stderr=subprocess.STDOUT,
                    start_new_session=True,  # Ctrl-C in a terminal reaches the stage alone, which asks once
                    env={**os.environ, "OMP_NUM_THREADS": "1", VARIABLE: "1"},
                )
        except OSError as error:
            self._turn.release()
            return f"it could not be started: {error.strerror}"
        self._began_s, self._is_asked_to_end = time.monotonic(), False
        return ""

    def ended(self) -> int | None:
        """None while it runs; then, once, its exit status, negative for the signal that has ended it."""
        status = self._child.poll() if self._child else None
        if status is not None:
            self._release()
        return status

    @property
    def last_line(self) -> str:
        """The last whole line that it has said; empty: none yet."""
        try:
            with self._log.open("rb") as log:
                log.seek(max(0, log.seek(0, os.SEEK_END) - _TAIL_BYTES))
                lines = log.read().decode(errors="replace").rpartition("\n")[0].splitlines()
        except OSError:
            return ""
        return next((line.removeprefix("fantwin: ") for line in reversed(lines) if line.strip()), "")

    def ask_to_end(self) -> None:
        """Once, however often it is called: a second signal would end it at once."""
        if self._child and not self._is_asked_to_end:
            self._child.terminate()
        self._is_asked_to_end = True

    def end(self, within_s: float) -> bool:
        """Ask it to end, and wait; returns whether it has ended."""
        self.ask_to_end()
        try:
            if self._child:
                self._child.wait(within_s)
        except subprocess.TimeoutExpired:
            return False
        if self._child:
            self._release()
        return True

    def kill(self) -> None:
        """End it at once."""
        if self._child:
            self._child.kill()
            self._child.wait()
            self._release()

    def _release(self) -> None:
        if self._child and self._child.stdin:
            self._child.stdin.close()
        self._child = None
        self._turn.release()
