"""The learner of one tray: which version of its twin is in force, and when the next one is learned.

It keeps the healthy history (pipeline.learning.healthy_history) and starts `fantwin twins learn` beside the stages,
which makes the next version and decides whether it takes over (pipeline.learning.next_version). An operator can change
the version in force: see `fantwin twins`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

from fantwin.pipeline.errors import UserError
from fantwin.pipeline.learning.fan_alarms import FanAlarms
from fantwin.pipeline.learning.healthy_history import HealthyHistory
from fantwin.pipeline.learning.learning_schedule import FIRST_S, LearningProcess, LearningSchedule, Work
from fantwin.pipeline.learning.ordinary_operation import OrdinaryOperation
from fantwin.pipeline.learning.requested_sweep import RequestedSweep
from fantwin.pipeline.learning.versions import TwinVersions, Version, VersionList, overlap
from fantwin.pipeline.recordings.dates import format_utc
from fantwin.pipeline.runtime.stage import Core, never
from fantwin.schemas.enums import Action
from fantwin.schemas.health import Learning
from fantwin.schemas.messages import Message, NewTwin, Raw, Request, Score
from fantwin.schemas.units import NS_PER_S

LOOK_NS = NS_PER_S
"""time between two looks for what has changed"""
FLUSH_NS = 10 * NS_PER_S
"""time between two flushes of the history to the disk: a crash loses as much"""
AHEAD_NS = 60 * NS_PER_S
"""largest lead of the history over the samples"""


class LearnerCore(Core):
    """The learner of one tray."""

    def __init__(
        self,
        fans: int,
        history: HealthyHistory,
        versions: TwinVersions,
        operation: OrdinaryOperation,
        learning: LearningProcess,
        sweep: RequestedSweep | None = None,
        is_replayed: Callable[[], bool] = never,
    ) -> None:
        """operation: what the fans have done in the history. learning: makes versions. sweep: for operators who ask for
        one; None: they may not. is_replayed: see Context."""
        self._fans = fans
        self._history = history
        self._versions = versions
        self._operation = operation
        self._learning = learning
        self._sweep = sweep
        self._is_replayed = is_replayed
        self._alarms = FanAlarms(fans)
        self._looked_ns = self._flushed_ns = 0
        self._seen_change: int | None = None
        self._is_list_read = False
        """true if the list of versions could be read; if not, nothing is learned: a new version could not be listed"""
        self._listed = VersionList()
        """the versions when they were last read"""
        self._in_force: Version | None = None
        """the one that was published"""
        self._schedule = LearningSchedule(history, operation)
        self._problems: dict[str, str] = {}
        """problems with the versions, by what was done with them"""

    def step(self, item: Raw | Score | Request) -> Sequence[Message]:
        """Add samples to the healthy history, or see whether a fan has an alarm or is commissioned again."""
        if isinstance(item, Request):
            if item.action == Action.COMMISSION:
                self._history.begin_after(item.t_ns)
                self._change_list(partial(self._versions.commission, item.t_ns))
            elif self._sweep and item.action in (Action.SWEEP, Action.STOP_SWEEP):
                self._sweep.take(item, self._looked_ns, self._why_no_sweep())
        elif item.fans != self._fans:
            pass  # of a tray that is configured otherwise
        elif isinstance(item, Score):
            self._see(item)
        else:
            self._history.add(item, has_alarm=bool(self._alarm_fans), is_watched=self._is_watched)
            if self._last is None:
                self._operation.take(item)
        return []

    def tick(self, now_ns: int) -> Sequence[Message]:
        """Publish the version in force when it has changed, and start learning when it is due."""
        if 0 <= now_ns - self._looked_ns < LOOK_NS:
            return []
        self._looked_ns = now_ns
        if not 0 <= now_ns - self._flushed_ns < FLUSH_NS:
            self._flushed_ns = now_ns
            self._history.flush()
        self._take_outcome()
        self._read_list()
        self._watch_sweep()
        self._schedule.forget_what_is_over(self._listed)
        cards = self._published(now_ns)
        if self._may_start and (due := self._schedule.due(self._listed, has_alarm=bool(self._alarm_fans))):
            self._start(due)
        return cards

    def close(self) -> Sequence[Message]:
        """Keep the history; a sweep leaves the fans at their former commands."""
        self._learning.stop()
        if self._sweep:
            self._sweep.end()
        self._history.close()
        return []

    def abort(self) -> None:
        """Stop learning and a sweep."""
        self._learning.stop()
        if self._sweep:
            self._sweep.end()

    def notes(self) -> Sequence[str]:
        """The version in force, what it finds and when the next one is due, or what the first one waits for; and what
        learning waits for."""
        if self._in_force is None:
            found = [self._waits_for()]
        else:
            found = [f"{self._in_force.name} is in force; {_finds(self._in_force)}{self._next_version()}"]
        current = self._listed.current
        if self._in_force and current and current != self._in_force:
            found.append(f"{current.name} waits: it takes over when no fan has an alarm, by the scores of all fans")
        if fans := self._alarm_fans:
            verb = "has" if len(fans) == 1 else "have"
            found.append(f"no version takes over while {self._operation.names.labels(fans)} {verb} an alarm")
        if self._sweep and (moving := self._sweep.note()):
            found.append(moving)
        work_s = self._learning.seconds
        if work_s is None:
            return found
        doing = "checking the fans" if self._schedule.work == "check" else "making the next version"
        return [*found, f"{doing}, for {work_s:.0f} s"]

    def learning(self) -> Learning | None:
        """What the first version waits for."""
        if self._in_force is not None or self._last is not None:
            return None
        recorded_s, fans = min(self._history.seconds, FIRST_S), self._operation.done()
        is_moved = not any(fan.missing for fan in fans)
        left_s = FIRST_S - recorded_s
        if self._learning.seconds is not None:
            what, is_moved = "the first twin is being made", False
        else:
            what = f"{recorded_s / 60.0:.0f} of {FIRST_S / 60.0:g} minutes recorded"
            what += "" if is_moved else "; the commands have not varied enough yet"
        return Learning(
            tray="",
            what=what,
            until_t_ns=self._history.newest_t_ns + round(left_s * NS_PER_S) if is_moved else 0,
            helps=self._operation.how_to_move if any(fan.missing for fan in fans) else "",
            fans=tuple(replace(fan, progress=min(fan.progress, recorded_s / FIRST_S)) for fan in fans),
            sweep=self._sweep.now() if self._sweep else None,
        )

    def problem(self) -> str:
        """Why nothing is learned, or that a version waits for the operator."""
        offered = self._listed.waiting
        problems = [
            *self._problems.values(),
            *(f"learning: {why}" for why in self._schedule.failures),
            self._history.problem,
            self._ahead(),
            self._sweep.problem() if self._sweep else "",
            f"{offered.name} is offered: {offered.why} (fantwin twins)" if offered else "",
        ]
        return "; ".join(dict.fromkeys(filter(None, problems)))

    @property
    def _may_start(self) -> bool:
        is_moving = self._sweep is not None and self._sweep.is_running
        return self._learning.is_free and self._is_list_read and not is_moving

    @property
    def _last(self) -> Version | None:
        """The newest version."""
        return self._listed.versions[-1] if self._listed.versions else None

    @property
    def _is_watched(self) -> bool:
        """Return whether samples wait until they are judged: there is a version, or it is not known whether there is
        one."""
        return not self._is_list_read or (self._last is not None and not self._is_tainted)

    @property
    def _alarm_fans(self) -> list[int]:
        """The fans with an alarm. Those of a twin that was learned from a fault do not count: they would keep it from
        being replaced."""
        return [] if self._is_tainted else self._alarms.fans

    @property
    def _is_tainted(self) -> bool:
        """Return whether the twin that the stages have was learned from a time that was marked as faulty."""
        return self._in_force is not None and overlap(self._in_force.learned_spans, self._listed.faulty)

    def _why_no_sweep(self) -> str:
        if self._is_replayed():
            return "a replay presents the tray"
        if self._last is not None:
            return "the tray has a twin"
        return "the first twin is being made" if self._learning.seconds is not None else ""

    def _watch_sweep(self) -> None:
        """Take its end; it stops when somebody has made the first twin by hand, as nothing shows it any more."""
        if self._sweep:
            self._sweep.tick()
            if self._last is not None:
                self._sweep.ask_to_end()

    def _see(self, score: Score) -> None:
        if not len(score.t_ns):
            return
        seen = self._alarms.update(score)
        for t_ns in seen.began_t_ns:
            self._change_list(partial(self._versions.add_alarm, t_ns, self._history.kept_since_t_ns))
        self._history.judged(seen.judged_t_ns, had_alarm=seen.had_alarm and not self._is_tainted)

    def _change_list(self, change: Callable[[], None]) -> None:
        try:
            change()
            self._problems["change"] = ""
        except (OSError, UserError) as error:
            self._problems["change"] = str(error)

    def _read_list(self) -> None:
        changed = self._versions.change_id
        if changed == self._seen_change and self._is_list_read:
            return
        try:
            listed = self._versions.read()
        except UserError as error:
            self._problems["list"], self._is_list_read = str(error), False
            return
        if listed.faulty != self._listed.faulty:
            self._history.finish()  # what was marked as faulty must not be part of what is recorded from now on
        if not self._is_list_read:
            self._problems.clear()
        self._listed, self._seen_change, self._is_list_read = listed, changed, True
        self._history.exclude(listed.excluded_spans)

    def _published(self, now_ns: int) -> list[NewTwin]:
        """The version that the stages are to use, if it is another one than before."""
        version = self._to_publish() if self._is_list_read else None
        if version is None:
            return []
        cards = [] if version == self._in_force else self._cards(version, now_ns)
        if self._in_force and self._in_force.name != self._listed.published:
            self._change_list(partial(self._versions.publish, self._in_force.name))
        return cards

    def _cards(self, version: Version, now_ns: int) -> list[NewTwin]:
        """The message of a version; none if its file cannot be read."""
        path = self._versions.file(version.name)
        try:
            content = path.read_bytes()
        except OSError as error:
            self._problems["file"] = f"{path}: cannot be read: {error.strerror}"
            return []
        self._problems["file"], self._in_force = "", version
        return [NewTwin(t_ns=now_ns, twin=version.name, sha256=version.sha256, content=content)]

    def _to_publish(self) -> Version | None:
        """The version in force, or while it has to wait, the one that the stages had before.

        One that was not chosen by an operator waits while a fan has an alarm, or may have one after a restart: with
        another twin the alarm would end, and the fault would be part of what the new one expects.
        """
        current = self._listed.current
        if current is None or self._listed.is_chosen or (self._alarms.are_known and not self._alarm_fans):
            return current
        return self._in_force or self._published_before() or current

    def _published_before(self) -> Version | None:
        """The version that the stages had before this process started, if its file is still there."""
        named = (each for each in self._listed.versions if each.name == self._listed.published)
        return next((each for each in named if self._versions.file(each.name).is_file()), None)

    def _start(self, work: Work) -> None:
        self._history.finish()
        self._schedule.started(work, self._listed)
        if problem := self._learning.start(only_if_changed=work == "check"):
            self._schedule.failed(problem)

    def _take_outcome(self) -> None:
        """Take the result of the version or check that was started last."""
        ended = self._learning.poll()
        if ended:
            self._schedule.failed(ended)
        elif ended is not None:
            self._schedule.succeeded()

    def _ahead(self) -> str:
        """Note that the history or the newest version is of later times than the samples."""
        end_t_ns = max(self._history.end_t_ns, self._last.made_t_ns if self._last else 0)
        if not self._history.newest_t_ns or end_t_ns - self._history.newest_t_ns <= AHEAD_NS:
            return ""
        return (
            f"the healthy history goes up to {format_utc(end_t_ns)}, and the samples are older: was the clock set "
            "back? Versions and checks may wait until this time has passed"
        )

    def _waits_for(self) -> str:
        minutes = self._history.seconds / 60.0
        missing = self._operation.missing()
        lacks = f"; not moved enough yet: {'; '.join(missing)}; {self._operation.how_to_move}" if missing else ""
        needed = f"{FIRST_S / 60.0:g} needed"
        return f"no twin yet, nothing is judged; {minutes:.0f} min recorded ({needed}){lacks}"

    def _next_version(self) -> str:
        """Time when it is due, as the end of a sentence; empty where something else decides."""
        wait_s = self._schedule.version_wait_s(self._listed)
        if wait_s is None or self._learning.seconds is not None:
            return ""
        return (
            f"; next version after {_duration(wait_s)} more of healthy running" if wait_s else "; next version is due"
        )


def _duration(seconds: float) -> str:
    return f"{seconds / 60.0:.0f} min" if seconds < 2 * 3600.0 else f"{seconds / 3600.0:.1f} h"


def _finds(version: Version) -> str:
    """Drops that the limits of a version find at its middle speed, and their false-alarm rate."""
    known = [drop for drop in version.drops if drop.within_60_s is not None]
    if not known:
        return version.rate_text
    drop, unit = known[len(known) // 2], version.speed_unit
    found = f"at {drop.speed:,.0f} {unit} it finds a drop of {drop.within_60_s:,.0f} {unit} within a minute"
    return f"{found}; {version.rate_text}"
