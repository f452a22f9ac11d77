"""How rare a large value is: the tail of a sample of maxima, and levels beyond it.

Above a high threshold excesses are taken to be exponential (peaks over threshold: Pickands, Annals of Statistics 3
(1975) 119, of shape zero). Sums and averages of residuals have such tails or lighter ones, so
levels come out rather too high.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from schemas.messages import Array

LEAST_PEAKS = 10
SHARE_OF_PEAKS = 0.1
MOST_PEAKS = 200
LEAST_SCALE = 1e-12
NORMAL_95 = 1.645


@dataclass(frozen=True)
class Tail:
    """P(x > level) = share exp(-(level - threshold) / scale) for levels above the threshold."""

    threshold: float
    scale: float
    share: float
    peaks: int = 0
    """values it rests on"""

    @classmethod
    def fit(cls, maxima: Array, probability: float) -> Tail:
        """Fit to (n,) values, for levels of about this probability.

        Rests on a tenth of the values, at least ten (half of them, where they are fewer), at most 200. Where ten values
        and more are above the level that is asked for, it is among the values themselves: no model is needed. Zeros
        count, but are no part of the tail.
        """
        ordered = np.sort(maxima[maxima > 0.0])[::-1]
        if not len(ordered):
            return cls(0.0, LEAST_SCALE, 1.0)
        expected = math.ceil(probability * len(maxima))
        peaks = min(max(LEAST_PEAKS, math.ceil(SHARE_OF_PEAKS * len(ordered))), MOST_PEAKS, max(1, len(ordered) // 2))
        if expected >= LEAST_PEAKS:
            peaks = min(expected, len(ordered))
        threshold = float(ordered[min(peaks, len(ordered) - 1)])
        excess = float((ordered[:peaks] - threshold).mean())
        return cls(threshold, max(excess, LEAST_SCALE), peaks / len(maxima), peaks)

    def upper_confidence_level(self, probability: float) -> float:
        """The upper end of the 95 % interval of `level`, one-sided: the scale is known by so many values only."""
        sure = 1.0 + NORMAL_95 / math.sqrt(max(self.peaks, 1))
        return self.threshold + sure * (self.level(probability) - self.threshold)

    def level(self, probability: float) -> float:
        """What is exceeded with this probability; the threshold, where that is more than `share`."""
        return self.threshold + self.scale * max(math.log(self.share / probability), 0.0)
