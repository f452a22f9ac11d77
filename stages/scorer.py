"""Scorer: compares the measurements with the twin, and maintains the alarm of each fan.

Reads: topic `prediction` (measured and predicted speed rad/s, torque balance in command units), `request` (what
operators request about alarms), and `twin` where twins are learned (pipeline.tray_scoring.learned_scorer).
Writes: topic `score` (residuals, what is expected of the fan, how much speaks for a fault, state), `overview` (the same
by the second, always recorded), `alarm` (every transition of a fan's alarm), `snapshot` (the state to continue from
after a restart).
Timing: one score message for every prediction message, immediately; of messages that wait together, one.

The core is pipeline.tray_scoring.scorer_core. See docs/explanation/deciding.md.
"""

from __future__ import annotations

from contextlib import suppress

from fantwin.pipeline.config.registry import STAGES
from fantwin.pipeline.errors import refusals
from fantwin.pipeline.prediction.tray_twin import TrayTwin, load_tray_twin, twin_path
from fantwin.pipeline.runtime.stage import BuiltStage, Context, Stage, StageError
from fantwin.pipeline.tray_scoring.healthy_twin import healthy_twin
from fantwin.pipeline.tray_scoring.learned_scorer import LearnedTwinScorer
from fantwin.pipeline.tray_scoring.scorer_config import ScorerConfig
from fantwin.pipeline.tray_scoring.scorer_core import ScorerCore
from fantwin.pipeline.tray_scoring.snapshot_store import Elsewhere, SnapshotStore
from fantwin.schemas.messages import ScorerSnapshot


def _kept_by_others(context: Context) -> Elsewhere | None:
    """Access to the snapshots that others keep of a tray; None: they are not asked."""
    kept, tray = context.kept, context.tray.name
    return (lambda is_patient: kept.of(tray, is_patient=is_patient)) if kept else None


def build(context: Context) -> BuiltStage:
    """The core of one tray; without a twin in the configuration, of the twins that are learned.

    Raises:
        StageError: the twin cannot be used; the snapshot file cannot be read, or another process uses it.
    """
    tray = context.tray
    path = context.snapshot_folder / f"scorer-{tray.name}.snapshot" if context.snapshot_folder else None
    store = SnapshotStore(path, _kept_by_others(context), context.started_t_ns) if path else None

    def core_of(twin: TrayTwin, continues: ScorerSnapshot | None = None) -> ScorerCore:
        return ScorerCore(
            tray.fans,
            tray.speed_unit,
            context.config,
            healthy_twin(context, twin),
            store,
            started_t_ns=context.started_t_ns,
            continues=continues,
            is_learned=tray.twin is None,
            is_replayed=context.is_replayed,
            names=tray.names,
        )

    twin = load_tray_twin(twin_path(tray, context.folder), tray.fans) if tray.twin else None
    if twin is not None:
        healthy_twin(context, twin)  # it may be refused, before the snapshot is locked
    if store:
        store.lock(f"site {context.site}")
    return BuiltStage(core_of(twin) if twin else LearnedTwinScorer(tray, core_of, store))


def check(context: Context) -> list[str]:
    """Why the scorer cannot run; the twin integrator reports a twin that cannot be loaded."""
    if context.tray.twin is None:
        return []
    with suppress(StageError):
        twin = load_tray_twin(twin_path(context.tray, context.folder), context.tray.fans)
        return refusals(lambda: healthy_twin(context, twin))
    return []


STAGE = Stage(
    row=STAGES["scorer"],
    about="the evidence for faults, and the fans' alarms",
    config=ScorerConfig,
    build=build,
    check=check,
)
