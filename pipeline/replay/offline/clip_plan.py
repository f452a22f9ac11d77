"""The plan of a replay of an alarm clip that begins in the middle of a scorer's session, with the scorer's snapshot.

Such a clip lacks what the stages before the scorer had in memory. A replay runs them over the clip's raw samples, which
begin early enough for them to settle; the scorer continues from the snapshot. The same alarms are raised, perhaps a few
samples earlier or later. To verify them, the scorer gets the recorded predictions
(pipeline.replay.offline.clip_tolerance).
"""

from __future__ import annotations

from collections.abc import Sequence

from fantwin.pipeline.replay.offline.plan import BEGINNING, Span, TrayPlan, undisturbed_plan
from fantwin.pipeline.replay.stage_chain import StageChain
from fantwin.schemas.messages import ModelCard, Request, ScorerSnapshot
from fantwin.schemas.streams import continues

NO_PREDICTIONS = (
    "an alarm clip without predictions cannot be compared: replay it without --verify to raise its alarms again"
)
AFTER_SNAPSHOT = "the clip begins after the snapshot from which it is scored"


def plan_from_snapshot(
    chain: StageChain, snapshot: ScorerSnapshot, twins: Sequence[ModelCard], requests: Sequence[tuple[int, Request]]
) -> TrayPlan:
    """One session of each stage; the scorer continues from the snapshot. requests: each with the time after which it
    was answered."""
    plan = undisturbed_plan(chain, twins)
    (scorer,) = plan.last
    scorer.snapshot = snapshot
    scorer.spans = [Span("", snapshot.t_ns + 1, None)]
    scorer.requests = [(t_ns, request) for t_ns, request in requests if t_ns >= snapshot.t_ns]
    return plan


def plan_with_recorded_inputs(plan: TrayPlan, snapshot: ScorerSnapshot) -> TrayPlan:
    """A recorded plan of which the scorer's part is replayed, from the snapshot and the recorded predictions."""
    plan.uses_recorded_inputs = True
    for session in (session for sessions in list(plan.sessions.values())[:-1] for session in sessions):
        session.limit = None
    scorer = plan.last[0]
    if scorer.snapshot is None:
        scorer.snapshot = snapshot
        scorer.lacks_evidence = True
        scorer.requests = [(t_ns, request) for t_ns, request in scorer.requests if t_ns >= snapshot.t_ns]
        scorer.snapshots_t_ns = [t_ns for t_ns in scorer.snapshots_t_ns if t_ns > snapshot.t_ns]
        known, first = snapshot.header.input_position, scorer.first_position
        follows = known is not None and first is not None and continues(known, first)
        if not follows or first is None or known is None or first.consumed_count != known.consumed_count + 1:
            scorer.set_limit(BEGINNING, AFTER_SNAPSHOT)
    return plan
