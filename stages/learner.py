"""Learner: learns the twin of a tray that names none, and improves it as healthy running accumulates.

Reads: topic `raw` (samples), `score` (whether a fan has an alarm), and `request` (fans that are commissioned again, and
sweeps).
Writes: topic `new_twin`: the version in force, at start and when it changes; while a fan has an alarm, the one before.
Timing: a version is made when the healthy history has doubled, at least once in a week of healthy running, and after
four hours of healthy running since an operator has commissioned fans again. While a fan has an alarm, only a version
that is offered may be made, for most fans have changed alike: that is checked beside alarms as well.

Its core is pipeline.learning.learner_core. The learner may drop messages: it must never delay a score.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress

from pydantic import Field

from fantwin.pipeline.config.registry import STAGES
from fantwin.pipeline.errors import UserError
from fantwin.pipeline.learning.child_command import ChildCommand
from fantwin.pipeline.learning.healthy_history import HealthyHistory, recorded_raws
from fantwin.pipeline.learning.learner_core import LearnerCore
from fantwin.pipeline.learning.learning_schedule import LearningProcess
from fantwin.pipeline.learning.ordinary_operation import OrdinaryOperation
from fantwin.pipeline.learning.requested_sweep import TURN, RequestedSweep
from fantwin.pipeline.learning.versions import TwinVersions, learning_folder
from fantwin.pipeline.recordings.metadata import recording_metadata
from fantwin.pipeline.runtime.stage import BuiltStage, Context, Core, Stage, StageConfig, StageError
from fantwin.schemas.messages import Message, Raw, Request, Score


class LearnerConfig(StageConfig):
    """Settings."""

    sweep_on_request: bool = Field(
        default=False,
        description="whether operators of the page may have the fans of a tray without a twin swept",
    )


class _NamesItsTwin(Core):
    """Learner of a tray that names its twin: it learns none."""

    def step(self, item: Raw | Score | Request) -> Sequence[Message]:
        """Do nothing."""
        return []


def build(context: Context) -> BuiltStage:
    """The core of one tray, with its history and versions.

    Raises:
        StageError: the versions or the history cannot be read.
    """
    tray = context.tray
    if tray.twin is not None:
        return BuiltStage(_NamesItsTwin())
    folder = learning_folder(context.run_folder, tray.name)
    metadata, attachments = recording_metadata(context)
    history = HealthyHistory(folder, context.site, tray.name, metadata, attachments)
    versions = TwinVersions(folder, tray.name)
    operation = OrdinaryOperation(tray)
    try:
        if not versions.all():
            for raw in recorded_raws(folder):
                operation.take(raw)
    except UserError as error:
        raise StageError(str(error)) from error
    assert context.configuration_path
    sets = [word for override in context.overrides for word in ("--set", override)]
    words = ["-c", str(context.configuration_path), "--tray", tray.name, *sets]
    learning = LearningProcess(words, folder / "learn.log")
    is_allowed = context.config.sweep_on_request and not tray.source.why_no_commands
    sweep = RequestedSweep(tray, words, ChildCommand(TURN, folder / "sweep.log")) if is_allowed else None
    return BuiltStage(LearnerCore(tray.fans, history, versions, operation, learning, sweep, context.is_replayed))


def check(context: Context) -> list[str]:
    """Problems that would keep it from learning."""
    with suppress(UserError):
        TwinVersions(learning_folder(context.run_folder, context.tray.name), context.tray.name).all()
        return []
    return ["the versions of the twin cannot be read: see `fantwin twins`"]


STAGE = Stage(
    row=STAGES["learner"],
    about="learns the twin of a tray that names none, from its healthy running",
    config=LearnerConfig,
    build=build,
    check=check,
)
