"""Scores the fans of several trays in one pass, where nothing happens that concerns one of the trays alone.

What a pass costs hardly depends on the number of fans: so many small trays cost little more than one. Each fan gets the
bits that its tray alone would give it. All statistics are of each fan by itself; what the fans of a tray share goes on
tray by tray (scoring.baseline.joint_shared_offset).
"""

from __future__ import annotations

from collections.abc import Sequence

from schemas.messages import Array
from scoring.fan_scorer import FanScorer
from scoring.joint_states import JointStates
from scoring.samples import Samples
from scoring.scored_block import ScoredBlock


def score_together(
    joint: FanScorer, of_trays: Sequence[FanScorer], samples: Samples, t_ns: Sequence[Array]
) -> ScoredBlock:
    """Score a block of as many samples of each of several trays with equal limits, numbers of fans and tachos.

    joint: a scorer of all fans together; what it holds is overwritten. samples: of all fans, with the times of the
    first tray. t_ns: (n,) of each tray, with equal steps; `is_interval_over` of them is equal, and known. Each scorer
    goes on as if it had scored its part.
    """
    is_over = of_trays[0].is_interval_over(samples.t_ns)
    assert is_over is not None
    for source, residual in joint.residuals.items():
        residual.share_as([each.residuals[source] for each in of_trays])
    states = JointStates(joint.states, [each.states for each in of_trays], [int(times[0]) for times in t_ns])
    states.gather()
    joint.begin_block(int(samples.t_ns[0]), is_interval_over=is_over)
    scored = joint.update(samples)
    states.scatter()
    for each, times in zip(of_trays, t_ns, strict=True):
        each.skip_block(int(times[-1]))
    return scored
