"""The plan of a replay of an alarm clip that begins in the middle of a scorer's session, with the scorer's snapshot.

Such a clip lacks what the stages before the scorer had in memory. A replay runs them over the clip's raw samples, which
begin early enough for them to settle; the scorer continues from the snapshot. The same alarms are raised, perhaps a few
samples earlier or later: so a clip is not verified, but the recording from which it was cut.
"""

from __future__ import annotations

from collections.abc import Sequence

from fantwin.pipeline.replay.offline.plan import Span, TrayPlan, undisturbed_plan
from fantwin.pipeline.replay.stage_chain import StageChain
from fantwin.schemas.messages import ModelCard, Request, ScorerSnapshot

NOT_VERIFIED = (
    "an alarm clip lacks what the stages had in memory where it begins: replay it without --verify to raise its alarms "
    "again, or verify the recording that it was cut from"
)


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
