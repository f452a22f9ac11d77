"""scoring.joint_scorer: trays scored in one pass go on as each alone, also while single fans are commissioned late."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np

from schemas.messages import Array
from scoring.fan_scorer import FanScorer
from scoring.joint_scorer import score_together
from scoring.samples import Samples
from tests.scoring.test_fan_scorer import SHORT_INTERVALS
from tests.support.healthy_residuals import rows_of, samples_of

TRAYS, FANS, BLOCK, INTERVALS = 4, 3, 5, 60
LATE_MS, LATER_NS = (0, 300, 300, 450), 20_000_000
"""by how much the last fan of each tray comes late; by how much the times of each tray are later"""


def run_of(rng: np.random.Generator, tray: int) -> Samples:
    """Intervals of one block each, at speeds that differ a little: they do not say the same about an offset."""
    samples = INTERVALS * BLOCK
    speed, balance = rng.normal(size=(2, samples, FANS))
    late = LATE_MS[tray] // 10
    speed[:late, -1] = balance[:late, -1] = np.nan
    made = samples_of(speed, balance)
    turning = np.repeat(rng.uniform(97.0, 103.0, (INTERVALS, FANS)), BLOCK, axis=0)
    return replace(made, speed_rad_s=turning, predicted_rad_s=turning, t_ns=made.t_ns + tray * LATER_NS)


def beside(samples: list[Samples]) -> Samples:
    columns = {name: [getattr(each, name) for each in samples] for name in vars(samples[0])}
    joined = {name: np.concatenate(of, axis=1) for name, of in columns.items() if np.ndim(of[0]) > 1}
    return replace(samples[0], **joined)


def parts(scores: Array, tray: int) -> Array:
    return scores[..., tray * FANS : (tray + 1) * FANS]


def test_trays_scored_in_one_pass_go_on_as_each_alone() -> None:
    passes = late_alone = 0
    for seed in range(3):
        rng = np.random.default_rng(seed)
        runs = [run_of(rng, tray) for tray in range(TRAYS)]
        alone, joined = ([FanScorer(FANS, SHORT_INTERVALS) for _ in runs] for _ in range(2))
        joint = FanScorer(TRAYS * FANS, SHORT_INTERVALS)
        for first in range(0, INTERVALS * BLOCK, BLOCK):
            blocks = [rows_of(run, slice(first, first + BLOCK)) for run in runs]
            expected = [scorer.update(block) for scorer, block in zip(alone, blocks, strict=True)]
            is_over = [scorer.is_interval_over(block.t_ns) for scorer, block in zip(joined, blocks, strict=True)]
            if None not in is_over and len(set(is_over)) == 1:
                passes += 1
                found = score_together(joint, joined, beside(blocks), [block.t_ns for block in blocks])
                for tray, of_tray in enumerate(expected):
                    for name, scores in vars(of_tray).items():
                        np.testing.assert_array_equal(parts(vars(found)[name], tray), scores, err_msg=name)
            else:
                late_alone += first > 11 * BLOCK
                for scorer, block in zip(joined, blocks, strict=True):
                    scorer.update(block)
            for one, other in zip(alone, joined, strict=True):
                assert json.dumps(one.snapshot()) == json.dumps(other.snapshot())
    assert passes > 3 * 20
    assert late_alone > 3, "intervals end while a fan is commissioned late"
