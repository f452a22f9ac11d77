"""Whether a recording used for calibration was probably not healthy: its scores are far above the others."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from pipeline.replay.offline.healthy_runs import HealthyRuns
from schemas.messages import Array
from scoring.calibration.calibration import DAY_S, VARIATION_FAN_S
from scoring.calibration.healthy_statistics import healthy_statistics, truncate_runs
from scoring.limits import Limits

MIN_FANS = 4  # fans, counted over all runs: with fewer the median says little
OUTLIER_RATIO = 3.0  # times the median: healthy fans that ran alike came to 1.7, faulty ones to 3.5 and more


class Outlier(NamedTuple):
    """The fan of a run with the highest score."""

    run: int
    """number of the run"""
    fan: int
    score: float
    median_score: float
    """of the highest scores of all fans of runs"""


def outlier_warning(runs: HealthyRuns, limits: Limits, top_speed_rad_s: float) -> str:
    """A warning about the fan of a recording whose score is far above the others; empty if there is none.

    limits: those that were found on these runs. Of more than five fan-days only the first part of each run is scored.

    Raises:
        UserError: a recording cannot be used.
    """
    assert limits.declared_rate
    is_long = limits.declared_rate.fan_hours > 24 * VARIATION_FAN_S / DAY_S
    part = truncate_runs(runs, limits.declared_rate.runs, VARIATION_FAN_S) if is_long else runs
    found = outlier([run.score for run in healthy_statistics(part, limits, top_speed_rad_s).maxima])
    if found is None:
        return ""
    tray = runs.trays[found.run]
    return (
        f"{tray.path}: {tray.tray} fan {found.fan} goes to {found.score:.2g} times the limits that were found, the "
        f"others mostly to {found.median_score:.2g}: if something was wrong there, calibrate without this recording"
    )


def outlier(scores: Sequence[Array]) -> Outlier | None:
    """The fan of a run with the highest score, if that is far above the others.

    scores: of each run (windows, fans), NaN where a fan was not scored.
    """
    highest = {
        (number, fan): float(np.nanmax(run[:, fan]))
        for number, run in enumerate(scores)
        for fan in range(run.shape[1])
        if np.isfinite(run[:, fan]).any()
    }
    if len(highest) < MIN_FANS:
        return None
    median = float(np.median(list(highest.values())))
    run, fan = max(highest, key=lambda key: highest[key])
    score = highest[run, fan]
    return Outlier(run, fan, score, median) if score > OUTLIER_RATIO * median else None
