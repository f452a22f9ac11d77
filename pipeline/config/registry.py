"""The registry of stages: one row each. It is data: reading it imports no stage, and a row starts nothing by itself.

Rows are in the order of the data flow. The launcher starts stages from the end, so that consumers are ready first, and
stops them from the beginning, so that messages in flight arrive. Other packages add stages that show or send, by entry
points of the group `fantwin.outputs`.
"""

from __future__ import annotations

import re

from fantwin.pipeline.plugins import StageRow, rows_of_others
from fantwin.schemas.topics import TOPICS

LEARNER = "learner"
"""the stage that gives a tray its twin"""
RECORDER = "recorder"
GATEWAY = "gateway"
VIEWER = "viewer"
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
            writes=("score", "overview", "alarm", "snapshot"),
        ),
        StageRow(
            RECORDER,
            "fantwin.stages.recorder:STAGE",
            enabled_by="default",
            reads=tuple(topic.name for topic in TOPICS if topic.recorded),
            keeps=("snapshot",),
        ),
        StageRow(
            "viewer",
            "fantwin.stages.viewer:STAGE",
            enabled_by="default",
            extra="view",
            has_common_shards=False,
            may_drop=True,
            reads=("score", "alarm", "snapshot"),
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


RESERVED = {
    *("format", "site", "run_folder", "bus", "launcher", "tray"),
    *("operator", "viewer", "source", "replay", "router"),
}
"""keys of the configuration and roles, which no stage may have for its name"""


def why_no_output(name: str, row: StageRow) -> str:
    """Why a row of another package cannot be used; empty if it can."""
    known = {topic.name for topic in TOPICS}
    if row.name != name:
        return f"its row is called {row.name!r}"
    if name in RESERVED or not re.fullmatch("[a-z][a-z0-9_]*", name):
        return "a stage may not have this name"
    if row.enabled_by != "section" or row.scope != "site":
        return "only a section of the configuration may enable it, once for the site"
    if not known.issuperset((*row.reads, *row.writes)):
        return f"its row reads or writes another topic than {', '.join(sorted(known))}"
    return "" if set(row.writes) <= {"request"} else "it may write requests and nothing else"


STAGES |= rows_of_others("fantwin.outputs", StageRow, STAGES, why_no_output)
