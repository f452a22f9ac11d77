"""Whether one of the recordings that a twin was calibrated on was healthy: what went far beyond all others in them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pipeline.replay.offline.healthy_runs import HealthyRuns
from schemas.messages import Array
from scoring.calibration.calibration import DAY_S, SCORE, SHAPE_FAN_S
from scoring.calibration.healthy_statistics import survey, truncate_runs
from scoring.limits import Limits

FEWEST = 4  # fans of runs: of fewer nobody knows what is usual
FAR_BEYOND = 3.0  # times as far as usual: healthy fans that ran alike came to 1.7, faulty ones to 3.5 and more


def doubt(runs: HealthyRuns, limits: Limits, top_speed_rad_s: float) -> str:
    """One line on the fan of a recording that went much further than the others did, by the limits that were found.

    Empty where none did. Of more than five fan-days the truncate_runs of all runs are looked at.

    Raises:
        UserError: a recording cannot be used.
    """
    assert limits.promise
    is_long = limits.promise.fan_hours > 24 * SHAPE_FAN_S / DAY_S
    of = truncate_runs(runs, limits.promise.runs, SHAPE_FAN_S) if is_long else runs
    went = [run[:, SCORE] for run in survey(of, limits, top_speed_rad_s).maxima]
    found = farthest(went)
    if found is None:
        return ""
    number, fan, far, usual = found
    run = runs.runs[number]
    return (
        f"{run.path}: {run.tray} fan {fan} goes to {far:.2g} times the limits that were found, the others mostly to "
        f"{usual:.2g}: if something was wrong there, calibrate without this recording"
    )


def farthest(went: Sequence[Array]) -> tuple[int, int, float, float] | None:
    """Number of the run, fan, how far that went, and how far is usual; None where all went alike.

    went: of each run (windows, fans), how far its score went, NaN where it was not judged.
    """
    far = {
        (number, fan): float(np.nanmax(run[:, fan]))
        for number, run in enumerate(went)
        for fan in range(run.shape[1])
        if np.isfinite(run[:, fan]).any()
    }
    if len(far) < FEWEST:
        return None
    usual = float(np.median(list(far.values())))
    number, fan = max(far, key=lambda key: far[key])
    return (number, fan, far[number, fan], usual) if far[number, fan] > FAR_BEYOND * usual else None
