"""Alarms by the score alone: one detector, whose ratio is the score, decides on the return after a fixed delay."""

from __future__ import annotations

from typing import Any

import numpy as np

from schemas.messages import Array
from scoring.alarms.return_rule import HoldingDetector


def by_score(off_delay_ns: int) -> tuple[HoldingDetector, ...]:
    return (HoldingDetector("score", off_delay_ns, grows_with_speed=False, return_share=0.0),)


def scores_alone(t_ns: Array, period_ns: int, score: Array) -> tuple[Any, ...]:
    """What TrayConditions.update takes, for scores (n, fans), NaN where a sample is not valid."""
    return t_ns, period_ns, score, ~np.isnan(score), score[:, np.newaxis], np.ones(score.shape)
