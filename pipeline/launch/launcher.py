"""`fantwin up`: starts all stages as processes, restarts those that die, stops all in the order of the data flow."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Collection, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from fantwin.pipeline.bus.errors import NoAnswerError
from fantwin.pipeline.bus.opening import credentials_of
from fantwin.pipeline.bus.session import Bus, join_bus
from fantwin.pipeline.config.registry import LEARNER, RECORDER, STAGES
from fantwin.pipeline.config.roles import role_names, roles_of
from fantwin.pipeline.config.settings import Config
from fantwin.pipeline.config.shards import StageProcess, own_file, process_list
from fantwin.pipeline.errors import UserError
from fantwin.pipeline.launch.processes import EXIT_CANNOT_START, Child, HangDetector
from fantwin.pipeline.launch.site_report import RunningProcess, SiteReport
from fantwin.pipeline.prediction.tray_twin import load_tray_twin, twin_path
from fantwin.pipeline.recordings.parts import part_files, part_path
from fantwin.pipeline.runtime.service_manager import SignsOfLife
from fantwin.pipeline.runtime.stage import load_stage
from fantwin.pipeline.site.loss_accounting import Launched
from fantwin.pipeline.site.site_watcher import SiteWatcher
from fantwin.pipeline.site.stage_states import note_lines
from fantwin.pipeline.timebase.host_clock import HOST_CLOCK
from fantwin.pipeline.timebase.stage_clock import REPLAY
from fantwin.schemas.enums import StageStatus
from fantwin.schemas.topics import ALL_TRAYS, alive_key

_POLL_S = 0.05
_SEARCH_S = 2.0  # this long after meeting one process, a launcher has discovered all others
_ORDERLY = (0, 3)  # exit status of a stage that stopped in order: without losses, or with losses
_READY_TIMEOUT_S = 30.0
_LAST_HEALTH_S = 2.0  # after the end of a process, for what it sent last
RESTART_DELAY_S, RESTART_DELAY_MAX_S = 0.2, 10.0
"""the delay before a dead stage is restarted doubles with every death, up to the second"""
_STABLE_S = 10.0  # a stage that ran this long starts again at the shortest delay


@dataclass
class _Slot:
    """One row of the process list and the state of its process."""

    row: StageProcess
    child: Child | None = None
    start_at_s: float = 0.0
    delay_s: float = RESTART_DELAY_S
    was_ready: bool = False
    was_seen: bool = False
    """whether the process that runs now has been on the bus"""
    sessions: list[Launched] = field(default_factory=list)
    """all that were started"""
    hung: str = ""
    """why it was killed, for people"""


@dataclass
class Outcome:
    """How a run ended."""

    restarts: dict[str, int] = field(default_factory=dict)
    killed: list[str] = field(default_factory=list)
    failed: list[str] = field(default_factory=list)
    lost: dict[str, int] = field(default_factory=dict)
    refused: dict[str, dict[str, int]] = field(default_factory=dict)
    """messages of others and input of devices, by stage and counter; no loss"""
    notes: list[str] = field(default_factory=list)
    """a line for each thing that the stages said last of their work: the rate of a grid, gaps, what was judged"""
    unusable: list[str] = field(default_factory=list)
    """a line for each device that sent no sample that could be used"""
    run_folder: str = ""
    recordings: list[str] = field(default_factory=list)
    """the parts that were recorded, in order"""

    @property
    def recorded(self) -> str:
        """The parts in a few words."""
        if len(self.recordings) > 1:
            return f"{self.recordings[0]} to {self.recordings[-1]}, {len(self.recordings)} parts"
        return self.recordings[0] if self.recordings else "nothing"

    @property
    def exit_code(self) -> int:
        """0: stopped in order; 3: data were lost; 1: a stage failed at the end or had to be killed, or all that a
        device sent was refused."""
        if self.killed or self.failed or self.unusable:
            return 1
        return 3 if any(self.lost.values()) else 0


class Launcher:
    """Runs the stages of one configuration until it is stopped."""

    def __init__(
        self,
        config: Config,
        overrides: Sequence[str],
        say: Callable[[str], None],
        trays: Collection[str] | None = None,
        when_started: Sequence[str] = (),
    ) -> None:
        """`say` is called with one line for each event. trays: of this host, see `process_list`. when_started:
        lines to print when all stages have started.

        Raises:
            UserError: the configuration has no stage, or no process has its first tray among them.
        """
        if not config.stages:
            raise UserError(f"{config.path}: launcher.stages and launcher.without leave no stage to run: correct them")
        self._config = config
        self._path: Path = config.path
        self._overrides = tuple(overrides)
        self._say = say
        self._when_started = when_started
        rows = process_list(config, trays)
        if not rows:
            raise UserError(f"{config.path}: no process has tray {', '.join(trays or ())} first: see launcher.shards")
        self._slots = [_Slot(row) for row in rows]
        self._hang_detector = HangDetector(config.launcher.watchdog_s)
        self._is_started = False
        """all stages have been started and waited for"""
        self.outcome = Outcome(run_folder=str(config.run_folder))

    def run(self, stop: threading.Event) -> Outcome:
        """Start all stages, supervise them until `stop` is set, stop all.

        Raises:
            UserError: a stage cannot run as configured; the others have been stopped.
        """
        self.refuse_unusable_twins()
        for slot in self._slots:  # an unusable certificate ends `up` before any stage has made a file
            credentials_of(self._config.bus, role_names(slot.row.stage, slot.row.shard))
        reads = {name: load_stage(name).reads_as_configured(self._config) for name in self._config.stages}
        with join_bus(self._config, stop, say=self._say) as bus:
            self._refuse_second_launcher(bus, stop)
            if problem := bus.certificate_warning():
                self._say(problem)
            before = set(self._parts())
            self._watcher = SiteWatcher(bus, self._config.site, roles_of(self._config), self._config.trays)
            signs = SignsOfLife.from_environment()
            try:
                self._start_all(stop)
                for line in self._when_started if self._is_started else ():
                    self._say(line)
                self._report = SiteReport(self._config.bus.endpoint, self._say, HOST_CLOCK.now_ns())
                signs.ready()
                while not stop.wait(_POLL_S):
                    signs.at_work(f"site {self._config.site}: {len(self._slots)} processes")
                    self._check_processes()
                    self._report_changes()
                self._restart_those_down()
            finally:
                signs.stopping()
                self._stop_all()
                self.outcome.recordings = [str(path) for part, path in self._parts().items() if part not in before]
                ready = [slot for slot in self._slots if slot.was_ready]  # one that was never ready has lost nothing
                sessions = {each for slot in ready for each in slot.sessions}
                self.outcome.lost = self._watcher.losses(sessions, reads)
                self.outcome.refused = self._watcher.refused()
                self.outcome.notes = note_lines(view.health for view in self._watcher.stages())
                self.outcome.unusable = self._watcher.unusable(sessions)
        return self.outcome

    def refuse_unusable_twins(self) -> None:
        """Refuse a twin that is missing or of other fans, by its card, before any stage has made a file.

        A tray that names none learns one. Where these stages read no device, a replay may publish its twin, or a
        learner that runs elsewhere. The stages check the rest.

        Raises:
            StageError: a twin is refused.
        """
        learns = LEARNER in self._config.stages or not self._has_devices
        needed = {name for slot in self._slots if STAGES[slot.row.stage].needs_twin for name in slot.row.shard.trays}
        for tray in self._config.trays:
            if tray.name in needed and (tray.twin or not learns):
                load_tray_twin(twin_path(tray, self._config.folder), tray.fans)

    def _refuse_second_launcher(self, bus: Bus, stop: threading.Event) -> None:
        """Refuse to start when stages of this site already run, or where a replay presents the site and a device would.

        The process at the endpoint, if there is one, may belong to this site, to another, or be no stage at all.
        """
        ours = {alive_key(self._config.site, slot.row.stage, slot.row.instance): slot.row.label for slot in self._slots}
        bus.wait_for_others(stop)
        until_s = time.monotonic() + _SEARCH_S
        has_said = False
        while True:
            try:
                alive = bus.alive(alive_key(self._config.site, "*", "*"))
            except NoAnswerError as error:
                if not has_said:
                    self._say(f"{error}; asking again")
                has_said = True
                if stop.wait(_POLL_S):
                    return
                continue
            if running := [label for key, label in ours.items() if key in alive]:
                raise UserError(
                    f"site {self._config.site!r} already runs at {self._config.bus.endpoint} ({', '.join(running)}): "
                    "stop that, or give this one another site or bus.endpoint"
                )
            if self._has_devices and alive_key(self._config.site, REPLAY, ALL_TRAYS) in alive:
                raise UserError(
                    f"a replay presents site {self._config.site!r} at {self._config.bus.endpoint}: stop it, leave "
                    "acquisition out of launcher.stages, or give this one another site or bus.endpoint"
                )
            if not bus.came_second or time.monotonic() >= until_s or stop.wait(_POLL_S):
                return

    @property
    def _has_devices(self) -> bool:
        return any(not _listens_only(slot.row) for slot in self._slots)

    def _parts(self) -> dict[tuple[Path, int], Path]:
        """The parts of the recordings that are there, by recording and number and in order, under their names when
        finished."""
        found: dict[tuple[Path, int], Path] = {}
        recorder: Any = self._config.sections.get(RECORDER)
        for slot in self._slots:
            if slot.row.stage == RECORDER and recorder is not None:
                path = self._config.run_folder / own_file(slot.row.instance, recorder.file)
                with suppress(OSError):
                    found |= {(path, number): part_path(path, number) for number, _ in sorted(part_files(path))}
        return found

    def _start_all(self, stop: threading.Event) -> None:
        """Consumers first: sources start when all others are ready, so that no first sample is missed."""
        sources = [slot for slot in self._slots if not _listens_only(slot.row)]
        listeners = [slot for slot in self._slots if _listens_only(slot.row)]
        for group in (listeners, sources):
            if stop.is_set():
                return
            for slot in reversed(group):
                if why := self._start(slot):
                    raise UserError(f"{why}; free memory, or allow more processes and open files (ulimit)")
            self._wait_until_ready(group, stop)
        self._is_started = not stop.is_set()

    def _wait_until_ready(self, slots: list[_Slot], stop: threading.Event) -> None:
        deadline = time.monotonic() + _READY_TIMEOUT_S
        while not stop.is_set() and any(not slot.was_ready for slot in slots):
            stop.wait(_POLL_S)
            self._check_processes()
            if time.monotonic() > deadline:
                late = ", ".join(slot.row.label for slot in slots if not slot.was_ready)
                self._say(f"{late}: not ready after {_READY_TIMEOUT_S:.0f} s, continuing; see `fantwin doctor`")
                return

    def _start(self, slot: _Slot) -> str:
        """Start its process; returns why the system has none for it, empty if it has."""
        slot.child, label = None, slot.row.label
        try:
            slot.child = Child(
                slot.row,
                self._path,
                self._overrides,
                lambda row, line: self._say(f"{row.label} | {line}"),
                HOST_CLOCK.offset_ns,
            )
        except OSError as error:
            return f"{label}: no process could be started: {error.strerror or error}"
        slot.was_seen, slot.hung = False, ""
        slot.sessions.append((label, slot.child.process_id))
        self._watcher.add_launched(slot.sessions[-1])
        self._say(f"{label}: started, process {slot.child.process_id}")
        return ""

    def _delay_start(self, slot: _Slot, now: float) -> None:
        slot.start_at_s = now + slot.delay_s
        slot.delay_s = min(2 * slot.delay_s, RESTART_DELAY_MAX_S)

    def _check_processes(self) -> None:
        """Notice stages that have died, and restart those that are due."""
        HOST_CLOCK.now_ns()  # it notices a step when it is read
        now = time.monotonic()
        for slot in self._slots:
            if slot.child is None:
                if slot.start_at_s and now >= slot.start_at_s and (why := self._start(slot)):
                    self._say(f"{why}; trying again in {slot.delay_s:.1f} s")
                    self._delay_start(slot, now)
                continue
            status = slot.child.exit_status()
            if status is None:
                slot.was_seen = slot.was_seen or self._watcher.is_ready(slot.child.process_id)
                slot.was_ready = slot.was_ready or slot.was_seen
                slot.child.hear(now)
                continue
            if status == EXIT_CANNOT_START and not slot.was_ready:
                slot.child.stop(0.1)
                reason, slot.child = slot.child.last_line, None  # `up` ends with this error alone
                raise UserError(reason or f"{slot.row.label} cannot start as configured")
            self._plan_restart(slot, status, now)
        self._kill_what_hangs(now)

    def _kill_what_hangs(self, now: float) -> None:
        running = [slot.child for slot in self._slots if slot.child and not slot.hung]
        hung = self._hang_detector.hung(running, now)
        for slot in self._slots:
            if hung and slot.child is hung:
                status = hung.notices.status
                before = f" (before that: {status})" if status not in ("", StageStatus.OK.words) else ""
                slot.hung = f"hangs: its main loop has not run for {now - hung.heard_s:.0f} s{before}; killed"
                hung.kill()

    def _report_changes(self) -> None:
        now = time.monotonic()
        processes = {
            slot.row.label: RunningProcess(slot.child.process_id, slot.child.is_at_work(now))
            for slot in self._slots
            if slot.child and slot.was_seen
        }
        self._report.stages(self._watcher.states(slot.row for slot in self._slots), processes)
        self._report.alarms(self._watcher.current_alarms())

    def _plan_restart(self, slot: _Slot, status: int, now: float) -> None:
        assert slot.child is not None
        if now - slot.child.started_s > _STABLE_S:
            slot.delay_s = RESTART_DELAY_S
        how = f"was ended by signal {-status}" if status < 0 else f"ended with status {status}"
        if status == EXIT_CANNOT_START:
            slot.child.stop(0.1)  # its last line may still be in the pipe
            how = f"cannot start: {slot.child.last_line}"
        self._say(f"{slot.row.label}: {slot.hung or how}, restarting in {slot.delay_s:.1f} s")
        slot.child.notices.close()
        self.outcome.restarts[slot.row.label] = self.outcome.restarts.get(slot.row.label, 0) + 1
        slot.child = None
        self._delay_start(slot, now)

    def _restart_those_down(self) -> None:
        """Start a stage that is down once more: it requests what it missed. Wait for it, and for one just restarted."""
        started = [slot for slot in self._slots if slot.child or slot.start_at_s]
        down = [slot for slot in started if slot.child is None or slot.child.exit_status() is not None]
        for slot in down:
            if why := self._start(slot):
                self.outcome.failed.append(slot.row.label)
                self._say(f"{why}; what it missed while it was down is lost")
        until_s = time.monotonic() + self._config.launcher.watchdog_s
        awaited = [slot for slot in started if slot.was_ready or slot in down]
        while time.monotonic() < until_s and not all(map(self._is_back, awaited)):
            time.sleep(_POLL_S)

    def _is_back(self, slot: _Slot) -> bool:
        child = slot.child
        return child is None or child.exit_status() is not None or self._watcher.is_ready(child.process_id)

    def _stop_all(self) -> None:
        """Stop in the order of the data flow: a stage ends when it has processed all input, its processes together.
        Before them the learner: a sweep that it has begun gives the fans their former commands through acquisition."""
        stages = dict.fromkeys(slot.row.stage for slot in self._slots)
        for stage in sorted(stages, key=lambda each: each != LEARNER):
            of_stage = [(slot, slot.child) for slot in self._slots if slot.row.stage == stage and slot.child]
            for _, child in of_stage:
                child.terminate()
            for slot, child in of_stage:
                self._stop(slot, child)

    def _stop(self, slot: _Slot, child: Child) -> None:
        status, problem = child.stop(self._config.launcher.watchdog_s), ""
        if status is None:
            self.outcome.killed.append(slot.row.label)
            self._say(f"{slot.row.label}: did not stop in {self._config.launcher.watchdog_s:.0f} s, killed")
        elif status not in _ORDERLY:
            problem = f"ended with status {status}: {child.last_line}"
        elif not self._has_reported(slot):
            problem = "its last health message did not arrive: what it lost is unknown"
        elif self._is_started and not slot.was_ready:
            problem = "was never ready: it has received nothing"
        if problem:
            self.outcome.failed.append(slot.row.label)
            self._say(f"{slot.row.label}: {problem}")
        slot.child = None

    def _has_reported(self, slot: _Slot) -> bool:
        """Whether the last health message of a stage, with its counts, has arrived; it may arrive after the process
        has ended. A stage that was never heard has nothing to report if it was still starting for the first time."""
        until_s = time.monotonic() + _LAST_HEALTH_S
        while True:
            last = self._watcher.last_health(slot.sessions[-1])
            if not slot.was_ready if last is None else last.status == StageStatus.STOPPED:
                return True
            if time.monotonic() >= until_s:
                return False
            time.sleep(_POLL_S)


def _listens_only(row: StageProcess) -> bool:
    """Whether a stage has all its input from the bus. Stages with a process for each tray may have a device."""
    return STAGES[row.stage].scope == "site"
