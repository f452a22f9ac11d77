"""Other `fantwin` commands as child processes, each in a session of its own; the one that runs gets a Ctrl-C."""

from __future__ import annotations

import json
import shlex
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from pipeline.bus.session import Bus
from pipeline.config.models import Config
from pipeline.errors import UserError
from schemas.codec import CodecError, decode
from schemas.messages import Raw
from schemas.topics import tray_key

FANTWIN = (sys.executable, "-P", "-m", "pipeline")
RECORDING_STAGES = ("acquisition", "resampler", "recorder")
FIRST_SAMPLE_S = 60.0
"""until a site that only records has started and its first sample has arrived"""
STANDARD_ERROR = 2
"""its file descriptor"""
_POLL_S = 0.1


class Stopped(Exception):  # noqa: N818  not an error
    """The user wants to stop."""


class Commands:
    """Runs commands, each to its end."""

    def __init__(self, stop: threading.Event, say: Callable[[str], None], *, quiet: bool) -> None:
        """say: is given each command line. quiet: what the commands print goes to standard error."""
        self.stop = stop
        self.say = say
        self.quiet = quiet

    def run(self, *words: object) -> None:
        """Run a command to its end.

        Raises:
            Stopped: the user wants to stop.
            UserError: it failed, and has said why.
        """
        line = [str(word) for word in words]
        self.say(f"fantwin {shlex.join(line)}")
        child = _started(line, stdout=STANDARD_ERROR if self.quiet else None)
        self.wait(child)
        if child.returncode:
            raise UserError(f"`fantwin {line[0]}` failed (exit code {child.returncode}); see the lines before this one")

    def wait(self, child: subprocess.Popen[str]) -> None:
        """Wait for its end; pass a wish to stop on."""
        while child.poll() is None:
            if self.stop.wait(_POLL_S):
                child.send_signal(signal.SIGINT)
                child.wait()
        if self.stop.is_set():
            raise Stopped


class RecordingSite:
    """`fantwin up` with only the stages that record, and the samples of its tray, while in its context."""

    def __init__(self, commands: Commands, config: Config, configured: list[str], log: Path) -> None:
        """configured: the words that give a command this configuration. log: what `up` says is added to it."""
        self._commands = commands
        self._config = config
        self._words = ["up", *configured, "--json", "--set", f"launcher.stages={json.dumps(RECORDING_STAGES)}"]
        self._log = log
        self._received: list[bytes] = []
        self._has_samples = False
        self._lock = threading.Lock()
        self.recordings: list[Path] = []
        """after the end"""
        self.lost: dict[str, int] = {}
        """the same, by stage"""

    def __enter__(self) -> Self:
        with self._log.open("a", encoding="utf-8") as log:
            self._up = _started(self._words, stdout=subprocess.PIPE, stderr=log)
        self._bus = Bus(self._config.bus, listens=False)
        self._bus.subscribe(tray_key(self._config.site, self._config.trays[0].name, "raw"), self._take)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bus.close()
        if self._up.poll() is None:
            self._up.send_signal(signal.SIGINT)
        answer, _ = self._up.communicate()
        if answer:
            outcome: dict[str, Any] = json.loads(answer)
            self.recordings = [Path(name) for name in outcome["recordings"]]
            self.lost = {name: count for name, count in outcome["lost"].items() if count}
        if error is None and self._up.returncode not in (0, 3):
            raise self._failed()

    def wait_for_samples(self) -> None:
        """Wait for the first samples.

        Raises:
            UserError: none arrives.
        """
        waited_s = 0.0
        while not self._has_samples:
            if waited_s > FIRST_SAMPLE_S:
                raise UserError(f"no sample of the tray in {FIRST_SAMPLE_S:.0f} s: run `fantwin doctor`")
            self.wait(_POLL_S)
            waited_s += _POLL_S

    def wait(self, seconds: float) -> list[Raw]:
        """Wait; returns the samples that have arrived since the last call.

        Raises:
            Stopped: the user wants to stop.
            UserError: the site has ended.
        """
        if self._commands.stop.wait(seconds):
            raise Stopped
        if self._up.poll() is not None:
            raise self._failed()
        with self._lock:
            received, self._received = self._received, []
        return [message for message in map(_raw, received) if message is not None]

    def _failed(self) -> UserError:
        lines = self._log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
        return UserError(f"recording failed: {lines[-1] if lines else 'no output'} (all lines: {self._log})")

    def _take(self, _key: str, payload: bytes) -> None:
        with self._lock:
            self._received.append(payload)
            self._has_samples = True


def _started(words: list[str], **streams: Any) -> subprocess.Popen[str]:
    command = [*FANTWIN, *words]
    return subprocess.Popen(command, stdin=subprocess.DEVNULL, text=True, start_new_session=True, **streams)


def _raw(payload: bytes) -> Raw | None:
    try:
        message = decode(Raw, payload)
    except CodecError:
        return None
    return message if isinstance(message, Raw) else None
