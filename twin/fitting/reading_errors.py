"""What the errors of a free run say of the readings: their scale, and how much each counts for the steady speeds.

Readings of a tacho that counts are of an unknown age, and a model may miss how a fan changes its speed: many speed up
faster than they slow down. Both make errors in proportion to the slope of the speed. In a fit in which all readings
count alike they are the largest, and the steady speeds are bent to make them smaller. So the variance of the errors is
taken as

    variance = steady + rise * slope^2

with both found from the errors of a first fit, and a reading counts by the inverse of its standard deviation.
"""

import numpy as np

from twin.fitting.trajectories import Trajectories
from twin.runs import Array

NORMAL_90_PERCENT = 1.645
OUTLIER_SCALES = 3.0
"""of the scale of all errors: beyond it an error says nothing of how they vary"""


def robust_scale(residual: Array, trajectories: Trajectories) -> Array:
    """(fans,) standard deviation of a normal residual with the same 90th percentile of magnitude.

    One sample in ten may be an outlier. Never below a millionth of the fan's speed range, nor above that range, which
    it is where the free run diverged.
    """
    fans = int(trajectories.fan.max()) + 1
    scale = np.ones(fans)
    for fan in np.unique(trajectories.fan):
        columns = trajectories.fan == fan
        compared = trajectories.compared[:, columns]
        magnitude = np.abs(residual[:, columns][compared])
        span = float(np.ptp(trajectories.speed_rad_s[:, columns][compared]))
        # A magnitude beyond the range carries no information and may be infinite.
        robust_std = float(np.quantile(np.fmin(magnitude, span), 0.9)) / NORMAL_90_PERCENT
        scale[fan] = max(robust_std, 1e-6 * span, np.finfo(float).tiny)
    return scale


def counts(trajectories: Trajectories) -> bool:
    """Whether a tacho counts; readings of one that does not all count alike."""
    return any(tacho.held_s > 0.0 for tacho in trajectories.tacho)


def reliability(error_rad_s: Array, speed_rad_s: Array, trajectories: Trajectories) -> Array:
    """(n, batch) the standard deviation of a reading while the speed is steady over that at its slope.

    error_rad_s: readings less those of a free run. speed_rad_s: of that free run. Both (n, batch).
    """
    slope = _slope(trajectories.measurement.of_speed(speed_rad_s), trajectories.measurement.t_s)
    usable = trajectories.compared & np.isfinite(slope) & np.isfinite(error_rad_s)
    weight = np.ones_like(slope)
    largest_rad_s = OUTLIER_SCALES * robust_scale(error_rad_s, trajectories)
    for fan in np.unique(trajectories.fan):
        if not trajectories.tacho[fan].held_s:
            continue
        columns = trajectories.fan == fan
        use = usable[:, columns]
        squared_slope = slope[:, columns][use] ** 2
        square = np.minimum(error_rad_s[:, columns][use] ** 2, largest_rad_s[fan] ** 2)
        if not squared_slope.size:
            continue
        is_steady = squared_slope <= np.median(squared_slope)
        steady, moving = square[is_steady].mean(), squared_slope[~is_steady]
        if not moving.size or steady <= 0.0:
            continue
        of_age = trajectories.tacho[fan].held_s ** 2 / 12.0
        rise = max(float(moving @ (square[~is_steady] - steady)) / float(moving @ moving), of_age)
        weight[:, columns] = np.where(use, np.sqrt(steady / (steady + rise * slope[:, columns] ** 2)), 1.0)
    return weight


def _slope(signal: Array, t_s: Array) -> Array:
    """(n, batch) change a second, the mean of before and after each sample; 0 over padding."""
    step_s = np.diff(t_s, axis=0)
    with np.errstate(invalid="ignore", over="ignore"):
        change = np.diff(signal, axis=0)
        slope = np.divide(change, step_s, out=np.zeros_like(change), where=step_s > 0.0)
        return (np.concatenate((slope[:1], slope)) + np.concatenate((slope, slope[-1:]))) / 2.0
