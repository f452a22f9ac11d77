"""The registry of stages: one row each. It is data: reading it imports no stage, and a row starts nothing by itself.

Rows are in the order of the data flow. The launcher starts stages from the end, so that consumers are ready first, and
stops them from the beginning, so that messages in flight arrive.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from typing import Any, Literal

from fantwin.schemas.topics import TOPICS


@dataclass(frozen=True)
class StageRow:
    """What is known about a stage without importing it.

    Attributes:
        name: also the name of its section in the configuration.
        declaration: import string of its `pipeline.runtime.stage.Stage`, `module:attribute`.
        enabled_by: what enables it where `launcher.stages` is not given. "default": always; "section": a section
            `[name]` in the configuration; "tray without twin": a tray that names no twin.
        extra: the extra of the installation that it needs. If it is missing, `fantwin up` leaves out the stage, unless
            `launcher.stages` names it.
        scope: one process for the site, or one for each tray, where `launcher.shards` says nothing of it. Only stages
            with a process for each tray may have a device.
        has_common_shards: a `launcher.shards` that is one number for all stages applies to it.
        may_drop: that of its declaration, for those who count losses and would wait long for its imports.
        reads, writes: those of its declaration, for those who must not import it; None: its declaration is asked.
        keeps: topics whose last message about each of its trays it keeps for others, also when the producer has gone.
        needs_twin: it cannot start unless every tray has a twin, or learns one.
    """

    name: str
    declaration: str
    enabled_by: Literal["default", "section", "tray without twin"] = "section"
    extra: str = ""
    scope: Literal["site", "tray"] = "site"
    has_common_shards: bool = True
    may_drop: bool = False
    reads: tuple[str, ...] | None = None
    writes: tuple[str, ...] | None = None
    keeps: tuple[str, ...] = ()
    needs_twin: bool = False

    def load(self) -> Any:
        """Import the stage and return its declaration."""
        module, _, attribute = self.declaration.partition(":")
        return getattr(import_module(module), attribute)

    def topics(self) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """What it reads and what it writes; imports the stage only if its row does not say so."""
        if self.reads is None or self.writes is None:
            stage = self.load()
            return stage.reads, stage.writes
        return self.reads, self.writes


LEARNER = "learner"
"""the stage that gives a tray its twin"""
RECORDER = "recorder"
GATEWAY = "gateway"
STAGES: dict[str, StageRow] = {
    row.name: row
    for row in (
        StageRow(
            "acquisition",
            "fantwin.stages.acquisition:STAGE",
            enabled_by="default",
            scope="tray",
            reads=("command", "reading"),
            writes=("raw",),
        ),
        StageRow("resampler", "fantwin.stages.resampler:STAGE", enabled_by="default", reads=("raw",), writes=("grid",)),
        StageRow(
            LEARNER,
            "fantwin.stages.learner:STAGE",
            enabled_by="tray without twin",
            may_drop=True,
            reads=("raw", "score", "request"),
            writes=("new_twin",),
        ),
        StageRow(
            "twin_integrator",
            "fantwin.stages.twin_integrator:STAGE",
            enabled_by="default",
            needs_twin=True,
            reads=("grid", "new_twin"),
            writes=("prediction", "twin"),
        ),
        StageRow(
            "scorer",
            "fantwin.stages.scorer:STAGE",
            enabled_by="default",
            needs_twin=True,
            reads=("prediction", "request", "twin"),
            writes=("score", "alarm", "snapshot"),
        ),
        StageRow(
            RECORDER,
            "fantwin.stages.recorder:STAGE",
            enabled_by="default",
            reads=tuple(topic.name for topic in TOPICS if topic.recorded),
            writes=(),
            keeps=("snapshot",),
        ),
        StageRow(
            "viewer",
            "fantwin.stages.viewer:STAGE",
            enabled_by="default",
            extra="view",
            has_common_shards=False,
            may_drop=True,
            reads=("score", "alarm", "twin", "health", "snapshot"),
            writes=(),
        ),
        StageRow(
            GATEWAY,
            "fantwin.stages.gateway:STAGE",
            enabled_by="default",
            has_common_shards=False,
            may_drop=True,
            reads=("score", "alarm", "twin", "snapshot", "health"),
            writes=("request",),
        ),
        StageRow(
            "opcua",
            "fantwin.stages.opcua:STAGE",
            has_common_shards=False,
            may_drop=True,
            reads=("score", "alarm", "twin"),
            writes=("request",),
        ),
        StageRow(
            "mqtt",
            "fantwin.stages.mqtt:STAGE",
            has_common_shards=False,
            may_drop=True,
            reads=("score", "alarm", "health"),
            writes=("request",),
        ),
        StageRow("notifier", "fantwin.stages.notifier:STAGE", has_common_shards=False, reads=("alarm",), writes=()),
    )
}
