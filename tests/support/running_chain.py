"""A whole chain for tests: a simulated tray, `fantwin up`, and a watcher, in processes that end with the test."""

from __future__ import annotations

import json
import os
import queue
import re
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from fantwin.pipeline.bus.session import Bus
from fantwin.pipeline.config.settings import BusConfig, TrayConfig
from fantwin.pipeline.selftest.scratch_site import FANTWIN
from fantwin.pipeline.site.site_watcher import SiteWatcher
from fantwin.pipeline.site.stage_states import StageView

DEMO = Path(__file__).parents[2] / "pipeline" / "demo"
SITE, TRAY, FANS = "demo", "tray1", 8
STAGES = ("acquisition", "resampler", "twin_integrator", "scorer", "recorder")
RATE_HZ, STEP_NS = 50, 20_000_000
"""rate of the samples of a chain: half of the rate of the demo, and of its work"""
DEADLINE_S = 300.0  # only what hangs takes as long, also on a busy machine


def fantwin(*words: object, timeout_s: float = DEADLINE_S) -> subprocess.CompletedProcess[str]:
    """Run a command to its end."""
    return subprocess.run(
        [*FANTWIN, *map(str, words)],
        capture_output=True,
        text=True,
        timeout=timeout_s,
        check=False,
        stdin=subprocess.DEVNULL,
    )


def eventually(
    condition: Callable[[], Any], what: str, deadline_s: float = DEADLINE_S, *, every_s: float = 0.02
) -> Any:
    """The first true result of `condition`. every_s: between two looks, longer where a look takes work."""
    until_s = time.monotonic() + deadline_s
    pause = threading.Event()
    while not (answer := condition()):
        assert time.monotonic() < until_s, f"in {deadline_s:.0f} s it did not come to pass that {what}"
        pause.wait(every_s)
    return answer


def is_running(process_id: int) -> bool:
    """Whether there is such a process and it is no zombie whose threads have all ended."""
    process = Path(f"/proc/{process_id}")
    try:
        is_zombie = (process / "stat").read_text().rpartition(")")[2].split()[0] == "Z"
        return not is_zombie or len(list((process / "task").iterdir())) > 1
    except OSError:
        return False


class RunningCommand:
    """A `fantwin` command in its own process, and the lines it writes to standard error."""

    def __init__(self, words: Iterable[object], stdout: int = subprocess.PIPE) -> None:
        """stdout: a file descriptor to write to, such as a terminal; a pipe for `output` where it is not given."""
        self.process = subprocess.Popen(
            [*FANTWIN, *map(str, words)],
            stdin=subprocess.DEVNULL,
            stdout=stdout,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        self.lines: list[str] = []
        self._output: queue.Queue[str] = queue.Queue()
        self._readers = [threading.Thread(target=self._read_errors, daemon=True)]
        if (pipe := self.process.stdout) is not None:
            self._readers.append(threading.Thread(target=lambda: self._output.put(pipe.read()), daemon=True))
        for reader in self._readers:
            reader.start()

    def _read_errors(self) -> None:
        assert self.process.stderr
        for line in self.process.stderr:
            self.lines.append(line.rstrip())

    def line_with(self, words: str) -> str:
        """The first line that holds these words; waits for it, or for the end of the process."""

        def found() -> str | None:
            line = next((line for line in self.lines if words in line), None)
            assert line or self.process.poll() is None, f"ended without saying {words!r}: {self.lines}"
            return line

        return eventually(found, f"it says {words!r}")

    def end(self, number: int = signal.SIGINT) -> int:
        """Send a signal and wait for the end; the exit status."""
        if self.process.poll() is None:
            self.process.send_signal(number)
        return self.process.wait(DEADLINE_S)

    def output(self) -> Any:
        """The JSON it printed; it must have ended."""
        return json.loads(self._output.get(timeout=DEADLINE_S))

    def kill(self) -> None:
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait()
        for reader in self._readers:
            reader.join(DEADLINE_S)


class Chain:
    """A tray that sends until stopped, the stages that judge and record it, and a watcher on their bus."""

    def __init__(
        self,
        folder: Path,
        endpoint: str,
        *settings: str,
        stages: Sequence[str] = STAGES,
        configuration: Path = DEMO / "demo.toml",
    ) -> None:
        self.folder = folder
        self.configuration = configuration
        self.endpoint = endpoint
        self.port = folder / "tray"
        own_rate = [f"resampler.rate_hz={RATE_HZ}"] if configuration == DEMO / "demo.toml" else []
        self.settings = [
            *own_rate,
            *(f"run_folder='{folder}'", f"tray.0.port='{self.port}'", f"bus.endpoint='{endpoint}'"),
            *("viewer.grpc_port=0", "viewer.file='view.rrd'", f"launcher.stages={json.dumps(list(stages))}"),
            "recorder.topics=['raw', 'grid', 'prediction', 'score']",
            # nothing is late, hangs or is cut short where other tests hold up a process for seconds
            *("resampler.watermark_s=600", "launcher.watchdog_s=300", *settings),
        ]
        self.stages = [f"{stage}/{TRAY}" if stage == "acquisition" else stage for stage in stages]
        self.tray: RunningCommand | None = None
        self.up: RunningCommand | None = None

    def words(self, command: str) -> list[str]:
        return [command, "-c", str(self.configuration), *(w for s in self.settings for w in ("--set", s))]

    def start_tray(self, *words: str) -> RunningCommand:
        truth = self.folder / "truth.json"
        self.tray = RunningCommand(
            [
                *("simulate", "--fans", FANS, "--set", "speed_unit=rpm", "--set", f"rate_hz={RATE_HZ}"),
                *("--link", self.port, "--truth", truth),
                *("--wait-for-reader", "--json", *words),
            ]
        )
        self.tray.line_with("fans on")
        return self.tray

    def start_up(self) -> RunningCommand:
        self.up = RunningCommand([*self.words("up"), "--json"])
        return self.up

    @contextmanager
    def watcher(self) -> Iterator[SiteWatcher]:
        with Bus(BusConfig(endpoint=self.endpoint), listens=False) as bus:
            yield SiteWatcher(bus, SITE, trays=[TrayConfig(name=TRAY, fans=FANS)])

    def process_ids(self) -> dict[str, int]:
        """The ids of the processes that `up` last reported as started, by label."""
        assert self.up
        found = (re.search(r"(\S+): started, process (\d+)", line) for line in self.up.lines)
        return {match[1]: int(match[2]) for match in found if match}

    def kill(self, watcher: SiteWatcher, label: str) -> float:
        """Kill a stage with SIGKILL; returns the seconds until its successor was on the bus."""
        old = self.process_ids()[label]
        began_s = time.monotonic()
        os.kill(old, signal.SIGKILL)

        def is_back() -> bool:
            view = view_of(watcher, label)
            return view is not None and view.alive and view.health.process_id != old

        self.eventually(watcher, is_back, f"{label} is back")
        return time.monotonic() - began_s

    def eventually(self, watcher: SiteWatcher, condition: Callable[[], Any], what: str) -> None:
        """Wait for a condition; if it does not come true, the error shows what the site says of itself."""
        try:
            eventually(condition, what)
        except AssertionError as error:
            views = (f"{view.health}, alive {view.alive}, {view.age_s:.1f} s ago" for view in watcher.stages())
            lines = self.up.lines[-30:] if self.up else ()
            raise AssertionError("\n".join((str(error), *lines, *views))) from error

    def recordings(self) -> list[Path]:
        return sorted(self.folder.glob("recording*.mcap"))

    def close(self) -> None:
        for running in (self.up, self.tray):
            if running:
                running.kill()
        for process_id in self.process_ids().values() if self.up else ():
            if is_running(process_id):
                os.kill(process_id, signal.SIGKILL)


def view_of(watcher: SiteWatcher, label: str) -> StageView | None:
    """The view of a stage that a watcher has, or None."""
    stage, _, tray = label.partition("/")
    return next((v for v in watcher.stages() if v.health.stage == stage and v.health.instance == (tray or "all")), None)


def published(view: StageView | None) -> int:
    return sum(output.published for output in view.health.outputs) if view else 0


def received(view: StageView | None) -> int:
    return sum(line.received for line in view.health.inputs) if view else 0
