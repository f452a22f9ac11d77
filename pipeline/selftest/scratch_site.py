"""A site of its own for a self-test: a simulated tray on a line, `fantwin up`, and a watcher of both."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any, Self

from fantwin.pipeline.bus.session import Bus
from fantwin.pipeline.config.loading import load_config
from fantwin.pipeline.errors import UserError
from fantwin.pipeline.selftest.stepped_clock import VARIABLE, set_offset_ns
from fantwin.pipeline.site.site_watcher import SiteWatcher
from fantwin.pipeline.site.stage_states import StageView
from fantwin.pipeline.sources.simulated.device import Device, PseudoTerminal, play, wait_for_reader
from fantwin.schemas.codec import decode
from fantwin.schemas.enums import Transition
from fantwin.schemas.messages import Alarm, Score
from fantwin.schemas.topics import stage_label, tray_key
from fantwin.schemas.units import RAD_S_PER_UNIT

FANTWIN = (sys.executable, "-P", "-m", "fantwin")
CONFIGURATION = Path(__file__).parents[1] / "demo" / "demo.toml"
SITE, TRAY, FANS = "demo", "tray1", 8
STAGES = (f"acquisition/{TRAY}", "resampler", "twin_integrator", "scorer", "recorder")
START_LIMIT_S = 60.0
GO_ON_LIMIT_S = 60.0
"""until judging goes on after a fault"""
_POLL_S = 0.05
_WRITE_BYTES = 1024
"""bytes in one write: a pseudo-terminal accepts a write of this size completely or not at all"""


class NotKept(Exception):  # noqa: N818  a result, not an error
    """A promise that was not kept; the text says what was seen instead."""


class DisturbedLine(PseudoTerminal):
    """The serial line of a simulated device, which can be held, cut and disturbed.

    What the device sends while nobody reads, or while the line is cut, is lost, as on a real line. What it sends while
    the line is held is delivered afterwards, as fast as the reader takes it.
    """

    def __init__(self, link: Path) -> None:
        super().__init__(link)
        self._waiting: deque[bytes] = deque()
        self.is_held = self.is_cut = False

    def write(self, data: bytes) -> bool:
        """Send a frame, behind what waits."""
        if not self.has_reader():
            self._waiting.clear()
            return False
        if not self.is_cut:
            self._waiting.append(data)
        while self._waiting and not self.is_held and super().write(self._waiting[0]):
            self._waiting.popleft()
        return True

    def inject(self, data: bytes) -> None:
        """Let bytes that the device does not send arrive with its next frame."""
        self._waiting += [data[first : first + _WRITE_BYTES] for first in range(0, len(data), _WRITE_BYTES)]


class ScratchSite:
    """Runs from entering to leaving its context; all its processes have ended after that."""

    def __init__(self, folder: Path, device: Device) -> None:
        """folder: for its files, empty but for `runs`. device: of `FANS` fans."""
        self.folder = folder
        self.run_folder = folder / "runs"
        """what the stages write"""
        self.run_folder.mkdir(exist_ok=True)
        self.overrides = (
            *(f"run_folder={json.dumps(str(self.run_folder))}", f"tray.0.port={json.dumps(str(folder / 'tray'))}"),
            f"bus.endpoint='tcp/127.0.0.1:{free_port()}'",
            "launcher.stages=" + json.dumps([stage.split("/")[0] for stage in STAGES]),
        )
        self.line = DisturbedLine(folder / "tray")
        self._unplugged = threading.Event()
        self._device = threading.Thread(target=self._play, args=(device,), daemon=True)
        self._clock_file = folder / "clock"
        self._ending = ExitStack()
        self.raised: list[Alarm] = []
        """the alarms raised so far"""
        self.judged = 0
        """samples so far that were judged for all fans"""

    def __enter__(self) -> Self:
        set_offset_ns(self._clock_file, 0)
        code = "from fantwin.pipeline.selftest import stepped_clock\n\nstepped_clock.install()\n"
        (self.folder / "sitecustomize.py").write_text(code, encoding="utf-8")
        path = os.pathsep.join(filter(None, (str(self.folder), os.environ.get("PYTHONPATH", ""))))
        environment = {**os.environ, VARIABLE: str(self._clock_file), "PYTHONPATH": path}
        with self._ending as ending:
            log = ending.enter_context((self.folder / "up.log").open("w", encoding="utf-8"))
            self.bus = ending.enter_context(Bus(load_config(CONFIGURATION, self.overrides).bus, listens=False))
            self.watcher = SiteWatcher(self.bus, SITE)
            self.bus.subscribe(tray_key(SITE, "*", "alarm"), self._on_alarm)
            self.bus.subscribe(tray_key(SITE, "*", "score"), self._on_score)
            ending.callback(self.line.close)
            ending.callback(self._unplug)
            self._device.start()
            up = ("up", *self.configured(), "--json")
            self.up = started(up, stdout=subprocess.PIPE, stderr=log, env=environment)
            ending.callback(self._kill)
            try:
                self.seconds_until_judged(START_LIMIT_S)
            except NotKept as error:
                raise UserError(f"the site of the self-test did not start: {error}: {self.last_line()}") from error
            self._ending = ending.pop_all()
        return self

    def __exit__(self, *_error: object) -> None:
        self._ending.close()

    def _kill(self) -> None:
        """All its processes, if they run."""
        stages = [view.health.process_id for view in self.watcher.stages() if view.alive]
        self.up.kill()
        self.up.wait()
        for process_id in stages:
            with suppress(ProcessLookupError):
                os.kill(process_id, signal.SIGKILL)

    def _play(self, device: Device) -> None:
        wait_for_reader(self.line, "binary", self._unplugged)
        play(device, self.line, "binary", RAD_S_PER_UNIT["rpm"], self._unplugged)

    def _unplug(self) -> None:
        self._unplugged.set()
        self._device.join()

    def configured(self) -> tuple[str, ...]:
        """The words that give a command this site's configuration."""
        return ("-c", str(CONFIGURATION), *(word for override in self.overrides for word in ("--set", override)))

    def command(self, *words: object, limit_s: float = START_LIMIT_S) -> subprocess.CompletedProcess[str]:
        """Run a `fantwin` command to its end.

        Raises:
            subprocess.TimeoutExpired: it did not end within the limit, and was killed.
        """
        return subprocess.run(
            [*FANTWIN, *map(str, words)],
            capture_output=True,
            text=True,
            timeout=limit_s,
            check=False,
            stdin=subprocess.DEVNULL,
        )

    def set_clock(self, offset_s: float) -> None:
        """Set the wall clock of all processes of this site."""
        set_offset_ns(self._clock_file, round(offset_s * 1e9))

    def view(self, label: str) -> StageView | None:
        """The stage as it reports itself; None if it has not."""
        views = self.watcher.stages()
        return next((each for each in views if stage_label(each.health.stage, each.health.instance) == label), None)

    def process_id(self, label: str) -> int:
        """The process of a stage.

        Raises:
            NotKept: the stage is not on the bus.
        """
        view = self.view(label)
        if view is None or not view.alive:
            raise NotKept(f"{label} is not on the bus: {self.last_line()}")
        return view.health.process_id

    def problem(self, label: str) -> str:
        """What a stage reports as wrong now."""
        view = self.view(label)
        return view.health.problem if view else ""

    def memory_bytes(self, label: str) -> int:
        """The resident memory of a stage."""
        pages = Path(f"/proc/{self.process_id(label)}/statm").read_text(encoding="ascii").split()[1]
        return int(pages) * os.sysconf("SC_PAGE_SIZE")

    def seconds_until(self, condition: Callable[[], Any], limit_s: float, otherwise: str) -> float:
        """How long it took until the condition held.

        Raises:
            NotKept: it did not within the limit; `otherwise` says what that means.
        """
        began_s = time.monotonic()
        while not condition():
            if time.monotonic() - began_s > limit_s:
                raise NotKept(f"{otherwise} within {limit_s:.0f} s")
            time.sleep(_POLL_S)
        return time.monotonic() - began_s

    def seconds_until_judged(self, limit_s: float = GO_ON_LIMIT_S, after: str = "") -> float:
        """Seconds until another hundred samples of all fans have been judged. after: what, for people.

        Raises:
            NotKept: the limit passed first.
        """
        before = self.judged
        return self.seconds_until(lambda: self.judged >= before + 100, limit_s, f"judging did not go on{after}")

    def seconds_until_replaced(self, label: str, old_process_id: int) -> float:
        """Seconds until a new process runs the stage.

        Raises:
            NotKept: none does.
        """

        def is_new() -> bool:
            view = self.view(label)
            return view is not None and view.alive and view.health.process_id != old_process_id

        return self.seconds_until(is_new, GO_ON_LIMIT_S, f"{label} was not restarted")

    def last_line(self) -> str:
        """The last line of what the processes have printed."""
        return lines_of(self.folder / "up.log")[-1]

    def stop(self) -> tuple[int, dict[str, Any]]:
        """Stop the site as Ctrl-C does; returns its exit code and outcome.

        Raises:
            NotKept: it does not stop.
        """
        self.up.send_signal(signal.SIGINT)
        try:
            output, _ = self.up.communicate(timeout=START_LIMIT_S)
        except subprocess.TimeoutExpired as error:
            raise NotKept(f"it did not stop within {START_LIMIT_S:.0f} s: {self.last_line()}") from error
        self._unplug()
        return self.up.returncode, json.loads(output or "{}")

    def recordings(self) -> list[Path]:
        """All parts of the recording."""
        return sorted(self.run_folder.glob("recording*.mcap*"), key=lambda path: (len(path.name), path.name))

    def _on_alarm(self, _key: str, payload: bytes) -> None:
        alarm = decode(Alarm, payload)
        if alarm.transition == Transition.RAISED:
            self.raised.append(alarm)

    def _on_score(self, _key: str, payload: bytes) -> None:
        self.judged += int(decode(Score, payload).valid.all(axis=1).sum())


def free_port() -> int:
    """A port on loopback that nothing uses."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def started(words: Iterable[object], **streams: Any) -> subprocess.Popen[str]:
    """A `fantwin` command as a process in a session of its own, which a Ctrl-C in the terminal does not reach."""
    command = [*FANTWIN, *map(str, words)]
    return subprocess.Popen(command, text=True, start_new_session=True, **{"stdin": subprocess.DEVNULL, **streams})


def lines_of(log: Path) -> list[str]:
    """What a command has printed into a file; one line if nothing."""
    return log.read_text(encoding="utf-8", errors="replace").strip().splitlines() or ["no output"]
