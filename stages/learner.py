"""Learner: learns the twin of a tray that names none, and improves it as healthy running accumulates.

Reads: topic `raw` (samples), `score` (whether a fan has an alarm), and `request` (fans that are commissioned again).
Writes: topic `new_twin`: the version in force, at start and when it changes.
Timing: a version is made when the healthy history has doubled, at least once in a week of healthy running, and after
four hours of healthy running since an operator has commissioned fans again.

It keeps the healthy history (pipeline.learning.healthy_history) and starts `fantwin learn` beside the stages, which
makes the next version and decides whether it takes over (pipeline.cli.twins.next_version). An operator can change the
version in force: see `fantwin twins`. The learner may drop messages: it must never delay a score.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from typing import Literal

from pydantic import Field

from pipeline.errors import UserError
from pipeline.learning.healthy_history import SHORTEST_RECORDING_S, HealthyHistory, recorded_raws
from pipeline.learning.learning_process import Learning, LearningProcess
from pipeline.learning.ordinary_operation import OrdinaryOperation
from pipeline.learning.versions import TwinVersions, Version, VersionList, learning_folder
from pipeline.optional_dependencies import how_to_install, is_installed
from pipeline.recordings.metadata import recording_metadata
from pipeline.runtime.stage import BuiltStage, Context, Core, Stage, StageConfig, StageError
from schemas.messages import Action, FanState, Message, NewTwin, Raw, Request, Score
from schemas.units import NS_PER_S
from scoring.samples import among

LOOK_NS = NS_PER_S
"""how often the learner looks for what has changed"""
AGAIN_AFTER = 1.25
"""after a failure, learning starts again when the history is this many times as long"""
LONGEST_WAIT_S = 7 * 24 * 3600.0
"""of healthy running between two versions"""
CHECK_AFTER_S = 24 * 3600.0
"""of healthy running between two checks of the fans against the reference"""
AFTER_COMMISSIONING_S = 4 * 3600.0
"""of healthy running after fans were commissioned again: then the twin is compared with them"""


class LearnerConfig(StageConfig):
    """Section `[learner]`, for trays that name no twin."""

    false_alarms_per_day: float = Field(
        default=1.0, ge=1e-6, le=8640, description="the rate to declare: false alarms per fan and day"
    )
    first_minutes: float = Field(default=10.0, ge=1.0, description="healthy running before the first version")
    hold_back_minutes: float = Field(
        default=10.0, ge=0, description="samples are learned from if no alarm was raised for this long after them"
    )
    kept_hours: float = Field(default=168.0, ge=48.0, description="healthy running to keep for learning")


class LearnerCore(Core):
    """The learner of one tray."""

    def __init__(
        self,
        fans: int,
        config: LearnerConfig,
        history: HealthyHistory,
        versions: TwinVersions,
        operation: OrdinaryOperation,
        learning: Learning,
    ) -> None:
        """operation: what the fans have done in the history. learning: makes versions."""
        self._fans = fans
        self._config = config
        self._history = history
        self._versions = versions
        self._operation = operation
        self._learning = learning
        self._has_alarm = False
        self._looked_ns = 0
        self._seen_change: int | None = None
        self._is_list_read = False
        """whether the list of versions could be read; if not, nothing is learned: a new version could not be listed"""
        self._listed = VersionList()
        """the versions when they were last read"""
        self._in_force: Version | None = None
        """the one that was published"""
        self._failed_s = 0.0
        """healthy running at the last attempt, if it failed; 0: it did not"""
        self._problem = ""

    def step(self, item: Raw | Score | Request) -> Sequence[Message]:
        """Add samples to the healthy history, or see whether a fan has an alarm or is commissioned again."""
        if isinstance(item, Request):
            if item.action == Action.COMMISSION:
                self._history.close()
                self._commission(item.t_ns)
            return []
        if isinstance(item, Score):
            if item.fans == self._fans and len(item.t_ns):
                self._has_alarm = bool(among(item.state, FanState.ALARM, FanState.RETURNING).any())
            return []
        if item.fans == self._fans:
            self._history.add(item, has_alarm=self._has_alarm, is_watched=self._in_force is not None)
            if self._last is None:
                self._operation.take(item)
        return []

    def _commission(self, t_ns: int) -> None:
        try:
            self._versions.commission(t_ns)
        except UserError as error:
            self._problem = str(error)

    def tick(self, now_ns: int) -> Sequence[Message]:
        """Publish the version in force when it has changed, and start learning when it is due."""
        if 0 <= now_ns - self._looked_ns < LOOK_NS:
            return []
        self._looked_ns = now_ns
        self._history.flush()
        ended = self._learning.poll()
        if ended:
            self._problem, self._failed_s = f"learning: {ended}", self._history.seconds
        elif ended is not None:
            self._problem, self._failed_s = "", 0.0
        cards = self._changed(now_ns)
        due = self._due() if self._learning.is_free else None
        if due:
            self._history.finish()
            if problem := self._learning.start(only_if_changed=due == "check"):
                self._problem, self._failed_s = f"learning: {problem}", self._history.seconds
        return cards

    def close(self) -> Sequence[Message]:
        """Keep the history."""
        self._learning.stop()
        self._history.close()
        return []

    def abort(self) -> None:
        """Stop learning."""
        self._learning.stop()

    def notes(self) -> Sequence[str]:
        """The version in force and what it finds; or what the first one waits for."""
        work = self._learning.seconds
        making = [f"making the next version, for {work:.0f} s"] if work is not None else []
        if self._in_force is None:
            return [self._waits_for(), *making]
        return [f"{self._in_force.name} is in force; {_finds(self._in_force)}", *making]

    def problem(self) -> str:
        """Why nothing is learned, or that a version waits for the operator."""
        offered = self._listed.waiting
        waits = f"{offered.name} is offered: {offered.why} (fantwin twins)" if offered else ""
        return "; ".join(filter(None, (self._problem, self._history.problem, waits)))

    @property
    def _last(self) -> Version | None:
        """The newest version."""
        return self._listed.versions[-1] if self._listed.versions else None

    def _changed(self, now_ns: int) -> list[NewTwin]:
        """The version in force, if it is another one than before.

        One that was not chosen by an operator waits while a fan has an alarm: with another twin the alarm would end,
        and the fault would be part of the new baselines.
        """
        changed = self._versions.change_id
        if changed == self._seen_change and self._is_list_read:
            return []
        try:
            listed = self._versions.read()
            if self._has_alarm and not listed.is_chosen:
                return []
            in_force = listed.current
            content = self._versions.file(in_force.name).read_bytes() if in_force else b""
        except (OSError, UserError) as error:
            self._problem, self._is_list_read = str(error), False
            return []
        if not self._is_list_read:
            self._is_list_read, self._problem = True, ""
        if listed.faulty != self._listed.faulty:
            self._history.finish()  # what was marked as faulty must not be part of what is recorded from now on
        self._listed, self._seen_change = listed, changed
        if in_force is None or in_force == self._in_force:
            return []
        self._in_force = in_force
        return [NewTwin(t_ns=now_ns, twin=in_force.name, sha256=in_force.sha256, content=content)]

    def _due(self) -> Literal["version", "check"] | None:
        """What is due: a version, or a check of the fans against the reference."""
        if self._has_alarm or not self._is_list_read:
            return None
        since, last = self._history.seconds_since, self._last
        if self._failed_s:
            again_s = max(AGAIN_AFTER * self._failed_s, self._failed_s + SHORTEST_RECORDING_S)
            return "version" if self._history.seconds >= again_s else None
        if last is None:
            is_enough = self._history.seconds >= 60.0 * self._config.first_minutes and not self._operation.missing()
            return "version" if is_enough else None
        if self._listed.commissioned_t_ns > last.made_t_ns:
            return "version" if since(self._listed.commissioned_t_ns) >= AFTER_COMMISSIONING_S else None
        if not self._listed.waiting and since(last.made_t_ns) >= min(last.learned_s, LONGEST_WAIT_S):
            return "version"
        checked_t_ns = max(last.made_t_ns, self._listed.check.t_ns if self._listed.check else 0)
        return "check" if since(checked_t_ns) >= CHECK_AFTER_S else None

    def _waits_for(self) -> str:
        minutes = self._history.seconds / 60.0
        missing = self._operation.missing()
        lacks = f"; not moved enough yet: {'; '.join(missing)}; `fantwin sweep` moves the fans" if missing else ""
        needed = f"{self._config.first_minutes:g} needed"
        return f"no twin yet, nothing is judged; {minutes:.0f} min recorded ({needed}){lacks}"


def _finds(version: Version) -> str:
    """What the limits of a version find at its middle speed, and their false-alarm rate."""
    known = [drop for drop in version.drops if drop.within_a_minute is not None]
    if not known:
        return version.rate_text
    drop, unit = known[len(known) // 2], version.speed_unit
    found = f"at {drop.speed:,.0f} {unit} it finds a drop of {drop.within_a_minute:,.0f} {unit} within a minute"
    return f"{found}; {version.rate_text}"


class _NamesItsTwin(Core):
    """Of a tray that names its twin: it learns none."""

    def step(self, item: Raw | Score | Request) -> Sequence[Message]:
        """Nothing."""
        return []


def build(context: Context) -> BuiltStage:
    """The core of one tray, with its history and versions.

    Raises:
        StageError: the versions or the history cannot be read.
    """
    tray, config = context.tray, context.config
    if tray.twin is not None:
        return BuiltStage(_NamesItsTwin())
    folder = learning_folder(context.run_folder, tray.name)
    metadata, attachments = recording_metadata(context)
    history = HealthyHistory(
        folder,
        context.site,
        tray.name,
        metadata,
        attachments,
        hold_back_s=60.0 * config.hold_back_minutes,
        kept_s=3600.0 * config.kept_hours,
    )
    versions = TwinVersions(folder, tray.name)
    operation = OrdinaryOperation(tray)
    try:
        if not versions.all():
            for raw in recorded_raws(folder):
                operation.take(raw)
    except UserError as error:
        raise StageError(str(error)) from error
    assert context.configuration_path
    learning = LearningProcess(context.configuration_path, context.overrides, tray.name, folder / "learn.log")
    return BuiltStage(LearnerCore(tray.fans, config, history, versions, operation, learning))


def check(context: Context) -> list[str]:
    """What would keep it from learning."""
    if context.tray.twin is None and not is_installed("torch"):
        return [f"no twin can be learned without the extra `train`; {how_to_install('train')}"]
    with suppress(UserError):
        TwinVersions(learning_folder(context.run_folder, context.tray.name), context.tray.name).all()
        return []
    return ["the versions of the twin cannot be read: see `fantwin twins`"]


STAGE = Stage(
    name="learner",
    about="learns the twin of a tray that names none, from its healthy running",
    reads=("raw", "score", "request"),
    writes=("new_twin",),
    config=LearnerConfig,
    build=build,
    may_drop=True,
    check=check,
)
