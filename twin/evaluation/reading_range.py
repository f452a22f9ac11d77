"""How far readings are from all those that the tachos may show of a free run: the residual that is scored at run time.

A count of unknown age shows the mean over its window, at some time within the last `held_s`. scoring.expected_reading
does the same on its grid; here samples are those of the runs. Fans that stop, stand or start are left out, for they are
not compared with the twin at run time.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d, minimum_filter1d

from fantwin.schemas.standstill import Standstill
from fantwin.twin.evaluation.accuracy import compared_readings, free_run_speeds
from fantwin.twin.models.model import TwinModel
from fantwin.twin.runs import Array, Run
from fantwin.twin.tacho_readings import measurement_of

SHORT_AGE = 1e-3
"""of a window: an age that hardly differs from none"""
SETTLING_S = 3.0
START_TIME_CONSTANTS = 5.0
LEAST_SHARE = 0.1


def reading_sigma_rad_s(
    model: TwinModel, parameters: Array, sigma_rad_s: Array, standstill: Standstill | None, pieces: Sequence[Run]
) -> Array:
    """(fans,) root mean square of that residual.

    sigma_rad_s: (fans,) that of the whole residual, which holds where no sample is left, and a tenth of it at least.
    """
    squares, counts = np.zeros_like(sigma_rad_s), np.zeros_like(sigma_rad_s)
    for piece in pieces:
        beyond = _beyond_range(piece, free_run_speeds(model, parameters, piece))
        judged = np.isfinite(beyond) & ~_starts_or_stands(piece, standstill)
        squares += np.sum(beyond**2, axis=0, where=judged)
        counts += judged.sum(axis=0)
    found = np.sqrt(squares / np.maximum(counts, 1.0))
    return np.where(counts > 0.0, np.maximum(found, LEAST_SHARE * sigma_rad_s), sigma_rad_s)


def _beyond_range(piece: Run, speed_rad_s: Array) -> Array:
    """(n, fans) distance of each reading from the nearest possible one; NaN where nothing is compared."""
    fresh = [
        tacho.model_copy(update={"update_s": SHORT_AGE * tacho.window_s}) if tacho.window_s > 0.0 else tacho
        for tacho in piece.tacho
    ]
    newest = measurement_of(replace(piece, tacho=tuple(fresh))).of_speed(speed_rad_s)
    low, high = newest.copy(), newest.copy()
    for fan, tacho in enumerate(piece.tacho):
        size = round(tacho.held_s / piece.median_period_s) + 1
        low[:, fan] = minimum_filter1d(newest[:, fan], size, origin=(size - 1) // 2)
        high[:, fan] = maximum_filter1d(newest[:, fan], size, origin=(size - 1) // 2)
    readings = compared_readings(piece)
    return readings - readings.clip(low, high)


def _starts_or_stands(piece: Run, standstill: Standstill | None) -> NDArray[np.bool_]:
    """(n, fans) whether a command that does not turn the fan has been given within the time that a start takes."""
    reach_s = max(tacho.reach_s for tacho in piece.tacho)
    since_s = SETTLING_S + reach_s
    started = piece.t_s - piece.t_s[0] >= since_s
    if standstill is None:
        return np.broadcast_to(~started[:, np.newaxis], piece.command.shape)
    settling_s = START_TIME_CONSTANTS * (standstill.coast_time_constant_s or 0.0)
    since_s = max(since_s, (standstill.start_s or 0.0) + reach_s + settling_s)
    size = round(since_s / piece.median_period_s) + 1
    lowest = minimum_filter1d(piece.command, size, axis=0, origin=(size - 1) // 2)
    return (lowest < standstill.turning_command) | ~started[:, np.newaxis]
