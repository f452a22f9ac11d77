"""What the errors of a free run say of the readings: their scale, what of them to expect, and how much each counts.

Readings of a tacho that counts are of an unknown age, and a model may miss how a fan changes its speed: many speed up
faster than they slow down. Both make errors while the speed changes. In a fit in which all readings count alike they
are the largest, and the steady speeds are bent to make them smaller. So of the errors of a first fit

    error = expected + noise,    expected = share * |by_inertia|,    variance of the noise = steady + rise * slope^2

are found for each fan. by_inertia is what a larger inertia changes in the readings: a fan with one inertia upwards and
another downwards differs from one with their mean by as much, always in one direction. Then the steady speeds are
fitted to the readings less what is expected, and a reading counts by the inverse of the standard deviation of its
noise.
"""

from dataclasses import dataclass

import numpy as np

from fantwin.twin.fitting.trajectories import Trajectories
from fantwin.twin.runs import Array

NORMAL_90_PERCENT = 1.645
OUTLIER_SCALES = 3.0
"""of the scale of all errors: beyond it an error says nothing of how they vary"""


@dataclass(frozen=True)
class ReadingErrors:
    """What is known of the errors of readings, (n, batch) each."""

    expected_rad_s: Array
    weight: Array
    """the standard deviation of a reading while the speed is steady over that at its slope"""

    @classmethod
    def unknown(cls, shape: tuple[int, ...]) -> "ReadingErrors":
        """None is expected, and all readings count alike."""
        return cls(np.zeros(shape), np.ones(shape))


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


def reading_errors(
    error_rad_s: Array,
    speed_rad_s: Array,
    by_inertia_rad_s: Array,
    trajectories: Trajectories,
    before: ReadingErrors,
) -> ReadingErrors:
    """What a free run says of the readings of tachos that count.

    error_rad_s: readings less those expected. speed_rad_s: of the free run. by_inertia_rad_s: what a larger inertia
    changes in the expected readings. All (n, batch). before: what was known, whose weights count.
    """
    slope = trajectories.measurement.slope(trajectories.measurement.of_speed(speed_rad_s))
    size = np.abs(by_inertia_rad_s)
    usable = trajectories.compared & np.isfinite(slope) & np.isfinite(size) & np.isfinite(error_rad_s)
    found = ReadingErrors.unknown(slope.shape)
    largest_rad_s = OUTLIER_SCALES * robust_scale(error_rad_s, trajectories)
    for fan in np.unique(trajectories.fan):
        columns = trajectories.fan == fan
        use = usable[:, columns]
        held_s = trajectories.tacho[fan].held_s
        if not held_s or not use.any():
            continue
        error = error_rad_s[:, columns][use].clip(-largest_rad_s[fan], largest_rad_s[fan])
        own, weight = size[:, columns][use], before.weight[:, columns][use] ** 2
        share = float(weight * own @ error) / max(float(weight * own @ own), np.finfo(float).tiny)
        noise = error - share * own
        rise = _rise_of_variance(slope[:, columns][use] ** 2, noise**2, held_s)
        found.expected_rad_s[:, columns] = np.where(use, share * size[:, columns], 0.0)
        found.weight[:, columns] = np.where(use, 1.0 / np.sqrt(1.0 + rise * slope[:, columns] ** 2), 1.0)
    return found


def _rise_of_variance(squared_slope: Array, square: Array, held_s: float) -> float:
    """How the mean square of errors grows with the squared slope, relative to that while the speed is steady."""
    is_steady = squared_slope <= np.median(squared_slope)
    steady, moving = float(square[is_steady].mean()), squared_slope[~is_steady]
    if not moving.size or steady <= 0.0:
        return 0.0
    of_age = held_s**2 / 12.0
    return max(float(moving @ (square[~is_steady] - steady)) / float(moving @ moving), of_age) / steady
