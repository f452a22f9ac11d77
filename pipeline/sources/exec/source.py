"""Samples that a program prints, a line of JSON each; it runs as long as its source.

A program that ends is started again. While acquisition is behind nobody reads what it prints, so that it waits. Its
last line on standard error says why it ended.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import threading
import time
from contextlib import suppress
from typing import IO

from fantwin.pipeline.sources.exec.config import ExecConfig
from fantwin.pipeline.sources.json_samples import (
    LARGEST_BYTES,
    JsonSamplesError,
    batches_of,
    command_json,
    parse_samples,
)
from fantwin.pipeline.sources.polling import DeviceError, PollingSource
from fantwin.pipeline.sources.source import ReadingBatch, Rejected, SourceContext
from fantwin.pipeline.timebase.host_clock import HOST_CLOCK
from fantwin.pipeline.timebase.receipt_times import ReceiptTimes

END_LIMIT_S = 2.0
"""time that a program has to end after SIGTERM, before it is killed"""
LOOK_S = 0.02
LONGEST_QUOTE = 120
"""characters of what a program has printed, in a reason"""


class ExecSource(PollingSource):
    """A `SampleSource`."""

    def __init__(self, config: ExecConfig, context: SourceContext) -> None:
        """Start nothing yet."""
        super().__init__(config, period_s=0.0)
        config.require_each_fan(context.fans)
        self._config = config
        self._context = context
        program, *arguments = config.program
        self._words = [str((context.folder / program).absolute()) if "/" in program else program, *arguments]
        self._receipts = ReceiptTimes()
        self._process: subprocess.Popen[bytes] | None = None
        self._listener = threading.Thread()
        self._unsent = b""
        """rest of a command for which the program's input had no room"""
        self._said = ""
        """last line on its standard error"""

    @property
    def name(self) -> str:
        """The program."""
        return self._config.program[0]

    @property
    def settings_to_check(self) -> str:
        """The setting that names the program."""
        return "source.program"

    def connect(self) -> None:
        """Start the program."""
        pipe = subprocess.PIPE
        self._said, self._unsent = "", b""
        with self._wake:
            if self._stopping:
                raise DeviceError("it is to end")
            try:
                process = self._process = subprocess.Popen(
                    self._words,
                    cwd=self._context.folder,
                    stdin=pipe if self._config.commands else subprocess.DEVNULL,
                    stdout=pipe,
                    stderr=pipe,
                    start_new_session=True,  # an interrupt of the terminal ends the stage, which ends the program
                )
            except (OSError, ValueError) as error:
                why = getattr(error, "strerror", None) or error
                raise DeviceError(f"cannot be run: {why}; correct source.program") from error
            if process.stdin:
                os.set_blocking(process.stdin.fileno(), False)
        self._listener = threading.Thread(target=self._listen, args=(process.stderr,), daemon=True)
        self._listener.start()

    def read(self) -> list[ReadingBatch]:
        """The samples of the next line."""
        process = self._process
        assert process and process.stdout
        line = process.stdout.readline(LARGEST_BYTES + 1)
        if line:
            return self._batches(line) if line.strip() else []
        _end(process)  # without its output it is of no use
        self._listener.join(END_LIMIT_S)
        code = process.returncode
        how = f"signal {-code}" if code < 0 else f"exit code {code}"
        said = f": {self._said}" if self._said else ""
        raise DeviceError(f"it ended with {how}{said}; it is started again, and has to run on", is_lost=True)

    def disconnect(self) -> None:
        """End the program and all that it has started."""
        with self._wake:
            process, self._process = self._process, None
        if process:
            _end(process)
            for pipe in filter(None, (process.stdin, process.stdout)):
                pipe.close()

    def stop(self) -> None:
        """End the program, and with it the thread that reads its lines."""
        with self._wake:
            self._stopping = True
            process = self._process
        if process:
            _end(process)
        super().stop()

    def send(self, command: tuple[float, ...], set_point: tuple[float, ...]) -> str:
        """Write a command to the program's input."""
        if self._why_no_commands:
            return self._why_no_commands
        with self._wake:
            if self._process is None or self._process.stdin is None or self._stopping:
                return f"{self.name} does not run"
            pipe, line = self._process.stdin.fileno(), command_json(command, set_point).encode() + b"\n"
            try:
                self._unsent = self._unsent[os.write(pipe, self._unsent) :]
                if not self._unsent:
                    self._unsent = line[os.write(pipe, line) :]
                    return ""
            except BlockingIOError:
                pass
            except OSError as error:
                return f"{self.name} takes no commands: {error.strerror}"
            return f"{self.name} does not read its commands"

    def check(self) -> list[str]:
        """Whether there is such a program; it is not run."""
        if shutil.which(self._words[0]):
            return []
        return [f"{self.name}: no program of this name that can be run: correct source.program, or chmod +x"]

    def _listen(self, lines: IO[bytes]) -> None:
        """Keep the last line that the program says on standard error."""
        with lines:
            while line := lines.readline(LARGEST_BYTES):
                if text := line.decode(errors="replace").strip():
                    self._said = text[:LONGEST_QUOTE]

    def _batches(self, line: bytes) -> list[ReadingBatch]:
        received_t_ns = HOST_CLOCK.now_ns()
        try:
            found = parse_samples(line, self._config, self._context.fans, self._context.speed_unit)
        except JsonSamplesError as error:
            begin = line[: LONGEST_QUOTE // 3].decode(errors="replace").strip()
            rejected = Rejected("malformed", f"{begin!r}: {error}", is_sample=True)
            return [ReadingBatch(received_t_ns, (rejected,), len(line))]
        return batches_of(found, received_t_ns, self._receipts, len(line))


def _end(process: subprocess.Popen[bytes]) -> None:
    """End a program with all that it has started: politely, then by force."""
    if process.returncode is not None:
        return
    with suppress(ProcessLookupError, PermissionError):  # there are none any more
        for sent in (signal.SIGTERM, signal.SIGKILL):
            os.killpg(process.pid, sent)
            until_s = time.monotonic() + END_LIMIT_S
            while time.monotonic() < until_s:
                process.poll()
                os.killpg(process.pid, 0)
                time.sleep(LOOK_S)
