"""The mean error of a twin over its range of speeds."""

from dataclasses import dataclass

import numpy as np

from fantwin.twin.runs import Array

BINS = 20
FEWEST = 20
SMALLEST_SHARE = 0.005


@dataclass(frozen=True)
class SpeedBin:
    """The errors (measured minus free run, rad/s) at free-run speeds around middle_rad_s."""

    middle_rad_s: float
    mean_rad_s: float
    std_rad_s: float


@dataclass(frozen=True, eq=False)
class SpeedSums:
    """Sums of the errors of each fan in bins of equal width over a range of speeds, (fans, BINS). They can be added."""

    count: Array
    error: Array
    square: Array

    def __add__(self, other: "SpeedSums") -> "SpeedSums":
        return SpeedSums(self.count + other.count, self.error + other.error, self.square + other.square)

    def error_std_rad_s(self) -> Array:
        """(fans,) standard deviation of all errors; NaN without any."""
        count, error, square = (sums.sum(axis=1) for sums in (self.count, self.error, self.square))
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.sqrt(np.maximum(square / count - (error / count) ** 2, 0.0))

    def bins(self, fan: int, range_rad_s: Array) -> tuple[SpeedBin, ...]:
        """The bins of one fan, without those that have too few samples. range_rad_s: (2,) of its speeds."""
        low, high = range_rad_s
        if not high > low:
            return ()
        edges = np.linspace(low, high, BINS + 1)
        enough = max(FEWEST, SMALLEST_SHARE * self.count[fan].sum())
        found = []
        for k in np.flatnonzero(self.count[fan] >= enough):
            mean = float(self.error[fan, k] / self.count[fan, k])
            variance = float(self.square[fan, k] / self.count[fan, k]) - mean**2
            found.append(SpeedBin(float(edges[k : k + 2].mean()), mean, max(variance, 0.0) ** 0.5))
        return tuple(found)


def speed_sums(predicted_rad_s: Array, error_rad_s: Array, range_rad_s: Array) -> SpeedSums:
    """The sums over samples. predicted_rad_s, error_rad_s: (n, fans), values that are not finite are ignored.
    range_rad_s: (2, fans) of speeds that the bins divide; the outermost ones go on beyond it.
    """
    fans = predicted_rad_s.shape[1]
    seen = np.isfinite(predicted_rad_s) & np.isfinite(error_rad_s)
    low, high = range_rad_s
    with np.errstate(invalid="ignore", divide="ignore"):
        place = np.nan_to_num(BINS * (predicted_rad_s - low) / (high - low))
    column = np.clip(place, 0, BINS - 1).astype(int) + BINS * np.arange(fans)
    error = error_rad_s[seen]
    sums = (np.bincount(column[seen], weights, fans * BINS) for weights in (np.ones(len(error)), error, error**2))
    count, total, square = (of.reshape(fans, BINS).astype(np.float64) for of in sums)
    return SpeedSums(count, total, square)
