"""Scores blocks of several trays with one twin in one pass. Processed alone, each would differ only by rounding."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.runtime.latest_kept import LatestKept
from pipeline.runtime.tray_scorer import TrayScorer
from schemas.messages import Alarm, Prediction, Score
from schemas.side_by_side import apart, side_by_side
from scoring.fan_scorer import FanScorer
from scoring.joint_scorer import score_together
from scoring.samples import samples_of
from scoring.score_message import score_of
from scoring.unseen_error import UnseenError

MOST_KEPT = 16
"""joint scorers, each for one number of trays: what they hold is small, and building one takes a millisecond"""


@dataclass(frozen=True, eq=False)
class _OfTrays:
    """What so many trays are scored with."""

    scorer: FanScorer
    unseen_error: UnseenError | None


class JointTrayScorer:
    """Of one process, for trays with any twins."""

    def __init__(self) -> None:
        self._kept = LatestKept[_OfTrays](MOST_KEPT)
        """by twin, fans of a tray, and number of trays"""

    def score(self, scorers: Sequence[TrayScorer], items: Sequence[Prediction]) -> list[tuple[Score, list[Alarm]]]:
        """As TrayScorer.score of each; the keys of their blocks are equal (`joint_key`)."""
        if len(scorers) == 1:
            return [scorers[0].score(items[0])]
        fans, joint, block = scorers[0].fans, self._of_trays(scorers), side_by_side(items)
        samples = samples_of(block, joint.unseen_error)
        of_fans, times = [each.fan_scorer for each in scorers], [item.t_ns for item in items]
        scored = score_together(joint.scorer, of_fans, samples, times)
        of_each = [slice(k * fans, (k + 1) * fans) for k in range(len(scorers))]
        parts = [scored.fans(part) for part in of_each]
        whole = [slice(0, len(block.t_ns))]
        decided = [each.decide(item, part, whole) for each, item, part in zip(scorers, items, parts, strict=True)]
        state = np.concatenate([of_tray for of_tray, _ in decided], axis=1)
        scores = apart(score_of(block, scored, state, samples.speed_unseen), times)
        return [
            (score, each.finish(item, samples.fans(part), of_tray, states, events, score))
            for each, item, part, of_tray, (states, events), score in zip(
                scorers, items, of_each, parts, decided, scores, strict=True
            )
        ]

    def _of_trays(self, scorers: Sequence[TrayScorer]) -> _OfTrays:
        first, count = scorers[0], len(scorers)

        def build() -> _OfTrays:
            twin = first.twin.of_trays(count, first.fans)
            return _OfTrays(FanScorer(count * first.fans, twin.limits, tachos=twin.tachos), twin.unseen_error)

        return self._kept.get((first.twin.sha256, first.fans, count), build)
