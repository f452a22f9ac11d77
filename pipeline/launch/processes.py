"""Child processes: one for each stage, or for each shard of a stage."""

from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable
from pathlib import Path

from fantwin.pipeline.config.shards import StageProcess
from fantwin.pipeline.launch.notices import Notices
from fantwin.pipeline.runtime.service_manager import VARIABLE as NOTIFY_VARIABLE
from fantwin.pipeline.timebase.host_clock import VARIABLE as CLOCK_VARIABLE

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
        command = [
            sys.executable,
            "-P",
            "-m",
            "fantwin",
            "up",
            "--only",
            row.stage,
            "-c",
            str(config_path),
            *row.shard.words,
        ]
        for override in overrides:
            command += ["--set", override]
        self.row = row
        self._is_asked_to_end = False
        self.started_s = time.monotonic()
        self.last_line = ""
        self._on_line = on_line
        self.notices = Notices()
        try:
            self._process = self._started([*command, "--until-stdin-closes"], clock_offset_ns)
        except OSError:
            self.notices.close()
            raise
        self._reader = threading.Thread(target=self._read, daemon=True)
        try:
            self._reader.start()
        except RuntimeError as error:  # the limit of threads, which is that of processes
            self._process.kill()
            self._process.wait()
            self.notices.close()
            raise OSError(errno.EAGAIN, os.strerror(errno.EAGAIN)) from error

    def _started(self, command: list[str], clock_offset_ns: int) -> subprocess.Popen[str]:
        # a process group of its own, so that Ctrl-C in the terminal reaches only the launcher, which stops all;
        # the launcher holds standard input open: when the launcher ends, however it ends, the child stops too
        return subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            errors="replace",
            start_new_session=True,
            env={
                **os.environ,
                NOTIFY_VARIABLE: self.notices.address,
                CLOCK_VARIABLE: str(clock_offset_ns),
            },
        )

    @property
    def process_id(self) -> int:
        """Its process id."""
        return self._process.pid

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
