"""Samples of one interval of the baselines."""

from __future__ import annotations

import numpy as np

from scoring.baseline.intervals import Intervals


def one_interval(samples: int) -> Intervals:
    """So many samples of the present one."""
    return Intervals(np.zeros(1, np.int64), samples, samples)
