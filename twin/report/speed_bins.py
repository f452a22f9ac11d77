"""The mean error of a twin over its range of speeds."""

from dataclasses import dataclass

import numpy as np

from twin.runs import Array

BINS = 20
FEWEST = 20
SMALLEST_SHARE = 0.005


@dataclass(frozen=True)
class SpeedBin:
    """The errors (measured minus free run, rad/s) at free-run speeds around middle_rad_s."""

    middle_rad_s: float
    mean_rad_s: float
    std_rad_s: float


def speed_bins(predicted_rad_s: Array, error_rad_s: Array) -> tuple[SpeedBin, ...]:
    """Bins of equal width over the speeds of the free run; those with too few samples are left out.

    predicted_rad_s, error_rad_s: (n,), values that are not finite are ignored.
    """
    seen = np.isfinite(predicted_rad_s) & np.isfinite(error_rad_s)
    speed, error = predicted_rad_s[seen], error_rad_s[seen]
    if speed.size == 0 or np.ptp(speed) == 0.0:
        return ()
    edges = np.linspace(speed.min(), speed.max(), BINS + 1)
    which = np.clip(np.digitize(speed, edges) - 1, 0, BINS - 1)
    enough = max(FEWEST, SMALLEST_SHARE * speed.size)
    return tuple(
        SpeedBin(float(edges[k : k + 2].mean()), float(error[which == k].mean()), float(error[which == k].std()))
        for k in range(BINS)
        if np.count_nonzero(which == k) >= enough
    )
