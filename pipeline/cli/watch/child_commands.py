"""Other `fantwin` commands as child processes, each in a session of its own; the one that runs gets a Ctrl-C.

What a command does for its user is then a list of commands, which the user sees and can repeat, and the memory of each
ends with it.
"""

from __future__ import annotations

import json
import shlex
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from itertools import count
from pathlib import Path
from typing import Any, Self

from fantwin.pipeline.acquisition.raw_samples import RawSamples
from fantwin.pipeline.bus.session import join_bus
from fantwin.pipeline.cli.watch.commission_state import RECORDING_ONLY
from fantwin.pipeline.config.registry import RECORDER
from fantwin.pipeline.config.settings import Config, TrayConfig
from fantwin.pipeline.errors import UserError
from fantwin.pipeline.selftest.scratch_site import lines_of, started
from fantwin.schemas.messages import Raw

SILENT_S = 60.0
"""without a sample, from the start of a recording on: the line is dead"""
STANDARD_ERROR = 2
"""its file descriptor"""
_POLL_S = 0.1


class Stopped(Exception):  # noqa: N818  not an error
    """The user wants to stop."""


class Commands:
    """Runs commands, each to its end."""

    def __init__(self, stop: threading.Event, say: Callable[[str], None], *, to_standard_error: bool) -> None:
        """say: is given each command line. to_standard_error: what the commands print goes to standard error."""
        self.stop = stop
        self.say = say
        self.to_standard_error = to_standard_error

    def run(self, *words: object, site: RecordingSite | None = None, as_messages: bool = False) -> None:
        """Run a command to its end; it ends early if its site does or the user wants to stop.

        Args:
            words: the command.
            site: of which it needs the samples.
            as_messages: what it prints goes to standard error.

        Raises:
            Stopped: the user wants to stop.
            UserError: it failed, and has said why.
        """
        line = [str(word) for word in words]
        self.say(f"fantwin {shlex.join(line)}")
        child = started(line, stdout=STANDARD_ERROR if as_messages or self.to_standard_error else None)
        while child.poll() is None:
            is_stopped = self.stop.wait(_POLL_S)
            if site:
                site.samples.take()  # nobody else does
            if is_stopped or (site and site.has_ended):
                child.send_signal(signal.SIGINT)
                child.wait()
        if self.stop.is_set():
            raise Stopped
        if site:
            site.check()
        if child.returncode:
            raise UserError(f"`fantwin {line[0]}` failed (exit code {child.returncode}) and has said why")


class RecordingSite:
    """`fantwin up` with only the stages that record, and the samples of some of its trays, while in its context."""

    def __init__(
        self, commands: Commands, config: Config, configured: list[str], log: Path, trays: Sequence[TrayConfig]
    ) -> None:
        """config: with the section of the recorder. configured: the words that give a command this configuration. log:
        what `up` says is added to it. trays: those whose samples are wanted; all of the configuration are recorded."""
        self._commands = commands
        self._config = config
        self._fans = {tray.name: tray.fans for tray in trays}
        file = f"recorder.file={json.dumps(str(next_recording_file(config)))}"
        self._words = ["up", *configured, "--json", "--until-stdin-closes", *RECORDING_ONLY, "--set", file]
        self._log = log
        self._last_sample_s = dict.fromkeys(self._fans, time.monotonic())
        self._ending = ExitStack()
        self.recordings: list[Path] = []
        """after the end"""
        self.lost: dict[str, int] = {}
        """the same, by stage"""

    def __enter__(self) -> Self:
        with self._log.open("a", encoding="utf-8") as log:
            self._up = started(self._words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=log)
        with self._ending as ending:
            ending.callback(self._end)
            bus = ending.enter_context(join_bus(self._config, listens=False))
            self.samples = RawSamples(bus, self._config.site, self._fans)
            self._ending = ending.pop_all()
        return self

    def __exit__(self, _kind: object, error: BaseException | None, _trace: object) -> None:
        self._ending.close()
        if error is None and self._up.returncode not in (0, 3):
            raise self._failed()
        if error is None and not self.recordings:
            raise UserError(f"nothing was recorded (all lines: {self._log})")

    @property
    def has_ended(self) -> bool:
        """Whether it has, by itself."""
        return self._up.poll() is not None

    def check(self) -> None:
        """Raises UserError if the site has ended."""
        if self.has_ended:
            raise self._failed()

    def wait_for_samples(self) -> None:
        """Wait for the first samples. Raises as `wait`."""
        while not self.wait(_POLL_S):
            pass

    def wait(self, seconds: float) -> list[Raw]:
        """Wait; returns the samples of the wanted trays that have arrived since the last call.

        Raises:
            Stopped: the user wants to stop.
            UserError: the site has ended, or no sample has arrived for long.
        """
        if self._commands.stop.wait(seconds):
            raise Stopped
        self.check()
        samples = [sample for sample in self.samples.take() if sample.fans == self._fans.get(sample.header.tray)]
        self._last_sample_s |= dict.fromkeys((sample.header.tray for sample in samples), time.monotonic())
        silences = [self.silence_of(tray) for tray in self._fans]
        if all(silences):
            raise UserError(silences[0])
        return samples

    def silence_of(self, tray: str) -> str:
        """That no sample of a tray has arrived for long, and the last line of `up`; empty if one has."""
        if time.monotonic() - self._last_sample_s[tray] <= SILENT_S:
            return ""
        return f"no sample for {SILENT_S:.0f} s: {lines_of(self._log)[-1]} (all lines: {self._log})"

    def _end(self) -> None:
        answer, _ = self._up.communicate()  # closes its standard input, at which it stops in order
        if answer:
            outcome: dict[str, Any] = json.loads(answer)
            self.recordings = [Path(name) for name in outcome["recordings"]]
            self.lost = {name: count for name, count in outcome["lost"].items() if count}

    def _failed(self) -> UserError:
        return UserError(f"recording failed: {lines_of(self._log)[-1]} (all lines: {self._log})")


def next_recording_file(config: Config) -> Path:
    """The name of a recording in a new folder of its own, relative to the run folder.

    A recorder deletes only in the folder of its own recording: the limits of the recorder that runs afterwards do not
    reach what a twin was trained on and is calibrated on.
    """
    file: Path = config.sections[RECORDER].file  # pyright: ignore[reportAttributeAccessIssue]
    folders = (file.with_name(f"commissioned-{number}") for number in count(1))
    free = next(folder for folder in folders if not (config.run_folder / folder).exists())
    return free / f"{free.name}.mcap"
