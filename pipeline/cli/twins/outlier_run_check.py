"""Fans of recordings that were probably not healthy: they differ from the others, or have most of the alarms."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from fantwin.pipeline.replay.offline.calibration_of_twin import CalibratedTwin
from fantwin.pipeline.replay.offline.healthy_runs import DecidedRun, LearnedRun
from fantwin.scoring.model.priors import Priors

LEAST_FANS = 4
"""fans, counted over all runs: with fewer the median says little"""
OUTLIER_RATIO = 5.0
"""times the median: one healthy fan in a thousand differs from its twin by so much more than the others"""
SO_LEAVE_IT_OUT = "if something was wrong there, calibrate without this recording"


def outlier_warnings(found: CalibratedTwin) -> list[str]:
    """A line for the fan whose mean speed differs most, and one for the fan with most alarms, where that is much."""
    warnings = [_of_mean(found.learned)]
    if found.calibration.limit_factor > 1.0 or found.calibration.is_exceeded:
        warnings.append(_of_alarms(found.by_theory))
    return [warning for warning in warnings if warning]


def _of_mean(runs: Sequence[LearnedRun]) -> str:
    shares = [
        (abs(float(share)), float(share), run, fan)
        for run in runs
        for fan, share in enumerate(run.sums.mean_share)
        if math.isfinite(share)
    ]
    if len(shares) < LEAST_FANS:
        return ""
    median = float(np.median([size for size, *_ in shares]))
    size, share, run, fan = max(shares, key=lambda each: each[0])
    if size <= max(OUTLIER_RATIO * median, Priors().twin_share):
        return ""
    than = "faster" if share > 0.0 else "slower"
    return (
        f"{run.tray.path}: {run.tray.tray} fan {fan} is {100 * size:.2g} % {than} than its twin in the "
        f"mean, half of all differ by {100 * median:.2g} % or less: {SO_LEAVE_IT_OUT}"
    )


def _of_alarms(runs: Sequence[DecidedRun]) -> str:
    alarms = [(count, run, fan) for run in runs for fan, count in enumerate(run.alarms)]
    total = sum(count for count, *_ in alarms)
    most, run, fan = max(alarms, key=lambda each: each[0])
    if 2 * most <= total or len(alarms) == 1:
        return ""
    return (
        f"{run.tray.path}: {run.tray.tray} fan {fan} has {most} of the {total} alarms that the limit by theory "
        f"raises: {SO_LEAVE_IT_OUT}"
    )
