"""What `fantwin up` says of a running site, written so that writing never delays or ends the program.

The reader of the output may go away or stop reading, and its disk may be full. So a separate thread writes the lines;
it counts those that it cannot write, and reports the count when it can write again. A line that keeps repeating is
folded: it is written again after 10 s, then after twice as long each time, with the number of repetitions. Control
characters in a line become spaces: a terminal would obey them.
"""

from __future__ import annotations

import os
import queue
import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime

from fantwin.pipeline.runtime.figures import without_figures
from fantwin.pipeline.runtime.health import LATENCY_WINDOW_S
from fantwin.pipeline.site.one_line import one_line
from fantwin.pipeline.site.stage_states import OFF_THE_BUS, WHY_SILENT, StageState, StageView, Word, note_lines
from fantwin.schemas.enums import Severity
from fantwin.schemas.health import Health
from fantwin.schemas.units import NS_PER_S
from fantwin.scoring.alarms.current_alarms import CurrentAlarm, clock

FOLD_S = 10.0
FOLD_MAX_S = 600.0
QUEUE_SIZE = 1000
"""lines that wait to be written; more than that are counted"""
_MAX_REMEMBERED = 1000  # lines that may be repeated
_POLL_S = 0.5
_CLOSE_LIMIT_S = 1.0


@dataclass(slots=True)
class _Written:
    """A line that was written, and may be repeated."""

    at_s: float
    fold_s: float = FOLD_S
    repeated: int = 0


class RepeatedLines:
    """Which lines to write: equal ones are folded."""

    def __init__(self) -> None:
        self._written: dict[str, _Written] = {}
        """the line written first is at the beginning"""

    def add(self, line: str, now_s: float) -> list[str]:
        """The line, or nothing if it repeats one that was written a short time ago."""
        if line in self._written:
            self._written[line].repeated += 1
            return []
        self._written[line] = _Written(now_s)
        if len(self._written) > _MAX_REMEMBERED:
            del self._written[next(iter(self._written))]
        return [line]

    def due(self, now_s: float) -> list[str]:
        """The lines that were repeated and have waited long enough, with the number of repetitions."""
        lines: list[str] = []
        for line, written in list(self._written.items()):
            if now_s - written.at_s < written.fold_s:
                continue
            if written.repeated == 0:
                del self._written[line]
                continue
            lines.append(_folded(line, written.repeated))
            self._written[line] = _Written(now_s, min(2 * written.fold_s, FOLD_MAX_S))
        return lines

    def rest(self) -> list[str]:
        """All repetitions that have not been written yet."""
        return [_folded(line, written.repeated) for line, written in self._written.items() if written.repeated]


def _folded(line: str, repeated: int) -> str:
    return f"{line} ... repeated {repeated} time{'s' if repeated > 1 else ''}"


class EventLog:
    """Writes lines, each with its time of day, to a file descriptor. `say` may be called from any thread, never blocks
    and never raises."""

    def __init__(self, descriptor: int, now_s: Callable[[], float] = time.monotonic) -> None:
        self._descriptor = descriptor
        self._now_s = now_s
        self._queue: queue.Queue[str | None] = queue.Queue(QUEUE_SIZE)
        self._unwritten = 0
        self._lock = threading.Lock()
        self._thread = threading.Thread(target=self._run, name="event log", daemon=True)
        self._thread.start()

    def say(self, line: str) -> None:
        """Write a line soon, or count it."""
        try:
            self._queue.put_nowait(line)
        except queue.Full:
            self._count_unwritten()

    def close(self) -> None:
        """Write what is still waiting, for a second at most: nobody may be reading."""
        try:
            self._queue.put(None, timeout=_CLOSE_LIMIT_S)
        except queue.Full:
            return
        self._thread.join(_CLOSE_LIMIT_S)

    def _run(self) -> None:
        repeated = RepeatedLines()
        while True:
            try:
                line = self._queue.get(timeout=_POLL_S)
            except queue.Empty:
                line = ""
            due = repeated.due(self._now_s())
            new = repeated.rest() if line is None else repeated.add(line, self._now_s()) if line else []
            for each in (*due, *new):
                self._write(each)
            if line is None:
                return

    def _write(self, line: str) -> None:
        with self._lock:
            unwritten, self._unwritten = self._unwritten, 0
        note = f"({unwritten} lines could not be written)\n" if unwritten else ""
        data = f"{note}{datetime.now():%H:%M:%S}  {one_line(line)}\n".encode(errors="replace")
        try:
            while data:
                data = data[os.write(self._descriptor, data) :]
        except OSError:  # the reader has gone, or the disk is full
            self._count_unwritten(unwritten + 1)

    def _count_unwritten(self, count: int = 1) -> None:
        with self._lock:
            self._unwritten += count


_ALL = "all stages"
_NOTE_AFTER_NS = 5 * NS_PER_S
"""a note that stands for a shorter time is of a moment"""
_UNHEARD = OFF_THE_BUS | {Word.SILENT}


@dataclass(frozen=True)
class RunningProcess:
    """The process of a stage, as its launcher knows it. is_at_work: its main loop ran a moment ago."""

    process_id: int
    is_at_work: bool


class SiteReport:
    """Reports each change once."""

    def __init__(self, endpoint: str, say: Callable[[str], None], started_t_ns: int) -> None:
        """started_t_ns: when all stages had been started, host time."""
        self._endpoint = endpoint
        self._say = say
        self._started_t_ns = started_t_ns
        self._late_since_t_ns: dict[str, int] = {}
        """by label"""
        self._said: dict[str, str] = {}
        """by subject: the last report, without its figures; empty: all is well"""
        self._notes: dict[str, dict[str, int]] = {}
        """by label: the statements of its notes, and since when each stands"""
        self._said_notes: set[str] = set()
        self._alarms: dict[tuple[str, int], tuple[str, int]] = {}
        """by tray and fan: what was said of its alarm last, and the onset of that alarm"""

    def stages(self, states: Sequence[StageState], processes: Mapping[str, RunningProcess]) -> None:
        """Report how the stages have changed. processes: those that run and have been on the bus, by label; the
        launcher reports the others when they end and start."""
        running = [(state, processes[state.label]) for state in states if state.label in processes]
        off = [state.label for state, process in running if state.word in _UNHEARD and process.is_at_work]
        is_of_all = len(running) > 1 and len(off) == len(running)
        all_off = is_of_all or bool(off and self._said.get(_ALL))  # they come back one after the other
        lost = f"the connection to the bus is lost: they work, but none of them is heard at {self._endpoint}"
        self._change(_ALL, lost if all_off else "", "heard on the bus again")
        for state, process in running:
            if not (all_off and state.label in off):
                self._change(state.label, self._fault(state, process), "at work again")
        for state in states:
            if state.view and state.view.alive:
                subject = f"{state.label}: problem"
                self._change(subject, self._problem(state.view), "the problem is resolved", name=state.label)
                self._report_notes(state.label, state.view.health)

    def _problem(self, view: StageView) -> str:
        """The problem of a stage. One that only a single health reports, or that is from before the sources of the site
        had started, is over: it would be said and resolved at once."""
        before = view.previous
        is_there = before is not None and before.problem and before.t_ns >= self._started_t_ns
        return view.health.problem if is_there else ""

    def _report_notes(self, label: str, health: Health) -> None:
        """Say each statement once: what a note says first, without the figures, which change all the time."""
        before, standing = self._notes.get(label, {}), {}
        for line in note_lines([health]):
            statement = without_figures(line.partition(";")[0])
            standing[statement] = before.get(statement, health.t_ns)
            if health.t_ns - standing[statement] >= _NOTE_AFTER_NS and statement not in self._said_notes:
                self._said_notes.add(statement)
                self._say(line)
        self._notes[label] = standing

    def _fault(self, state: StageState, process: RunningProcess) -> str:
        """What is wrong with a stage whose process runs; empty if nothing is."""
        if state.word not in _UNHEARD:
            return f"{state.word}: {state.detail}" if state.is_fault and not self._is_catching_up(state) else ""
        if process.is_at_work:
            where = f"process {process.process_id} works, but is not heard at {self._endpoint}"
            return f"the connection to the bus is lost: {where}"
        return f"silent: {WHY_SILENT}"

    def _is_catching_up(self, state: StageState) -> bool:
        """Whether a stage has been late for no longer than its latencies reach back: after a restart, it and the stages
        after it process what they missed."""
        if state.word != Word.LATE or state.view is None:
            self._late_since_t_ns.pop(state.label, None)
            return False
        t_ns = state.view.health.t_ns
        return t_ns - self._late_since_t_ns.setdefault(state.label, t_ns) <= LATENCY_WINDOW_S * NS_PER_S

    def alarms(self, alarms: Iterable[CurrentAlarm]) -> None:
        """Say how the alarms have changed, and of one that has come and gone since the last call that it was raised:
        what was missed is judged in a moment. alarms: the current one of each fan that had one."""
        before, self._alarms = self._alarms, {}
        for current in alarms:
            alarm, line = current.newest, current.line()
            fan = (alarm.header.tray, alarm.fan)
            last_line, last_onset_t_ns = before.get(fan, ("", 0))
            is_new = last_onset_t_ns != alarm.onset_t_ns >= self._started_t_ns
            if is_new and not alarm.active and alarm.severity != Severity.NONE:
                at = clock(alarm.onset_t_ns)
                self._say(f"{current.severity()}  {fan[0]}  {alarm.label}: raised for what began at {at}, and over")
            if is_new or line != last_line:
                self._say(line)
            self._alarms[fan] = (line, alarm.onset_t_ns)

    def _change(self, subject: str, fault: str, when_over: str, name: str = "") -> None:
        meaning = without_figures(fault)
        if meaning != self._said.get(subject, ""):
            self._said[subject] = meaning
            self._say(f"{name or subject}: {fault or when_over}")
