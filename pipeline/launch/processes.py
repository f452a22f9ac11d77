"""Child processes, one for each stage or shard of a stage: what they report by systemd's protocol
(pipeline.runtime.service_manager), and which of them hangs.
"""

from __future__ import annotations

import errno
import math
import os
import secrets
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Protocol, TypeVar

from fantwin.pipeline.config.shards import StageProcess
from fantwin.pipeline.runtime.service_manager import FILE_VARIABLE
from fantwin.pipeline.runtime.service_manager import VARIABLE as NOTIFY_VARIABLE
from fantwin.pipeline.site.stage_states import START_LIMIT_S
from fantwin.pipeline.timebase.host_clock import VARIABLE as CLOCK_VARIABLE

_AT_WORK_S = 2.0
_OWN_PAUSE_S = 1.0  # the launcher itself did not run: the machine was suspended or very busy


class Heard(Protocol):
    """A process that says when its main loop runs. Times: monotonic clock, s."""

    heard_s: float
    """when it ran last, or when the process was started"""

    @property
    def is_ready(self) -> bool:
        """Whether it has said that it is ready."""
        ...


_Process = TypeVar("_Process", bound=Heard)


class HangDetector:
    """Names the process that hangs.

    A stage that publishes to a hung stage is soon blocked itself. So only the process that has been silent longest is
    named. All others get a new period, because they go on once it is gone.
    """

    def __init__(self, limit_s: float) -> None:
        """limit_s: how long a process may be silent."""
        self._limit_s = limit_s
        self._checked_s = math.inf

    def hung(self, running: Sequence[_Process], now_s: float) -> _Process | None:
        """The process that hangs; None if none does.

        Call it at least once a second: a longer pause is taken to be one of the caller itself, and no process is blamed
        for it.
        """
        pause_s, self._checked_s = now_s - self._checked_s, now_s
        if pause_s > _OWN_PAUSE_S:
            for each in running:
                each.heard_s = min(now_s, each.heard_s + pause_s)
        limits_s = {True: self._limit_s, False: max(self._limit_s, START_LIMIT_S)}
        overdue = [each for each in running if now_s - each.heard_s > limits_s[each.is_ready]]
        found = min(overdue, key=lambda each: each.heard_s, default=None)
        for each in running if found else ():
            if each is not found:
                each.heard_s = now_s
        return found


_MAX_BYTES = 4096


class Notices:
    """The socket of one child. Only on Linux: its name is an abstract one, which leaves no file behind."""

    def __init__(self) -> None:
        """Open the socket.

        Raises:
            OSError: the system is out of memory or open files.
        """
        self.address = f"@fantwin-{os.getpid()}-{secrets.token_hex(8)}"
        """value of NOTIFY_SOCKET for the child"""
        self.is_ready = False
        self.status = ""
        """its last status line"""
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        try:
            self._socket.setblocking(False)
            self._socket.bind(f"\0{self.address[1:]}")
        except OSError:
            self._socket.close()
            raise

    def read(self) -> bool:
        """Read all that has arrived; returns whether the child's main loop has run since the last call."""
        was_at_work = False
        while True:
            try:
                data = self._socket.recv(_MAX_BYTES)
            except OSError:  # nothing more
                return was_at_work
            for line in data.decode(errors="replace").split("\n"):
                name, _, value = line.partition("=")
                was_at_work |= name == "WATCHDOG"
                self.is_ready |= name == "READY"
                self.status = value if name == "STATUS" else self.status

    def close(self) -> None:
        """Release the socket."""
        self._socket.close()


EXIT_CANNOT_START = 78  # the stage cannot run as configured; one line on stderr says why (EX_CONFIG of sysexits.h)


class Child:
    """One running child process. Each line of its standard error is passed to `on_line`."""

    def __init__(
        self,
        row: StageProcess,
        config_path: Path,
        overrides: Iterable[str],
        on_line: Callable[[StageProcess, str], None],
        clock_offset_ns: int,
    ) -> None:
        """clock_offset_ns: of the time that it goes on with.

        Raises:
            OSError: the system has no room for another process; nothing is left of it.
        """
        command = [*(sys.executable, "-P", "-m", "fantwin", "up", "--only", row.stage, "-c", str(config_path))]
        command += [*row.shard.words, *(word for override in overrides for word in ("--set", override))]
        self.row = row
        self._is_asked_to_end = False
        self.started_s = self.heard_s = time.monotonic()
        self.last_line = ""
        self._on_line = on_line
        self.notices = Notices()
        self._reader = threading.Thread(target=self._read, daemon=True)
        with ExitStack() as undo:
            undo.callback(self.notices.close)
            # a process group of its own, so that Ctrl-C in the terminal reaches only the launcher, which stops all;
            # the launcher holds standard input open: when the launcher ends, however it ends, the child stops too
            self._process = subprocess.Popen(
                [*command, "--until-stdin-closes"],
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                text=True,
                errors="replace",
                start_new_session=True,
                env={
                    **os.environ,
                    NOTIFY_VARIABLE: self.notices.address,
                    FILE_VARIABLE: "",  # it is of the launcher: a child's sign of life is none of its own
                    CLOCK_VARIABLE: str(clock_offset_ns),
                },
            )
            undo.callback(self._process.wait)
            undo.callback(self._process.kill)
            try:
                self._reader.start()
            except RuntimeError as error:  # the limit of threads, which is that of processes
                raise OSError(errno.EAGAIN, os.strerror(errno.EAGAIN)) from error
            undo.pop_all()

    @property
    def process_id(self) -> int:
        """Its process id."""
        return self._process.pid

    @property
    def is_ready(self) -> bool:
        """Whether it has said that it is ready."""
        return self.notices.is_ready

    def hear(self, now_s: float) -> None:
        """Take what it has said."""
        if self.notices.read():
            self.heard_s = now_s

    def is_at_work(self, now_s: float) -> bool:
        """Whether its main loop ran a moment ago."""
        return now_s - self.heard_s < _AT_WORK_S

    def exit_status(self) -> int | None:
        """None while it runs; negative: ended by that signal."""
        return self._process.poll()

    def kill(self) -> None:
        """End it at once: it hangs, and catches no other signal."""
        self._process.kill()

    def terminate(self) -> None:
        """Ask it to end, once: a second signal would end it at once."""
        if not self._is_asked_to_end and self._process.poll() is None:
            self._process.send_signal(signal.SIGTERM)
        self._is_asked_to_end = True

    def stop(self, timeout_s: float) -> int | None:
        """Terminate it and wait; returns its exit status, None when it had to be killed.

        A process that was still starting does not catch the signal yet. It ends by it, as asked: status 0.
        """
        self.terminate()
        try:
            status = self._process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
            status = None
        if status == -signal.SIGTERM:
            status = 0
        self._reader.join(timeout=1.0)
        self.notices.close()
        return status

    def _read(self) -> None:
        assert self._process.stderr is not None
        for line in self._process.stderr:
            self.last_line = line.rstrip()
            self._on_line(self.row, self.last_line)
