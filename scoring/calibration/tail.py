"""How rare a large value is: the tail of a sample of maxima, and levels beyond it.

Excesses over a high threshold are taken to be exponential (peaks over threshold with shape zero: Pickands, Annals of
Statistics 3 (1975) 119). Sums and averages of residuals have such tails or lighter ones, so levels tend to be too high
rather than too low.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from schemas.messages import Array

MIN_PEAKS = 10
SHARE_OF_PEAKS = 0.1
MAX_PEAKS = 200
MIN_SCALE = 1e-12
NORMAL_95 = 1.645


@dataclass(frozen=True)
class Tail:
    """P(x > level) = share exp(-(level - threshold) / scale) for levels above the threshold."""

    threshold: float
    scale: float
    share: float
    peaks: int = 0
    """number of values above the threshold"""

    @classmethod
    def fit(cls, maxima: Array, probability: float) -> Tail:
        """Fit to (n,) values, for levels of about this probability.

        The fit uses a tenth of the values, at least ten (or half of them, if they are fewer) and at most 200. If ten
        values or more are above the level, it is read from the values themselves. Zeros count in `share`, but are not
        fitted.
        """
        ordered = np.sort(maxima[maxima > 0.0])[::-1]
        if not len(ordered):
            return cls(0.0, MIN_SCALE, 1.0)
        expected = math.ceil(probability * len(maxima))
        peaks = min(max(MIN_PEAKS, math.ceil(SHARE_OF_PEAKS * len(ordered))), MAX_PEAKS, max(1, len(ordered) // 2))
        if expected >= MIN_PEAKS:
            peaks = min(expected, len(ordered))
        threshold = float(ordered[min(peaks, len(ordered) - 1)])
        excess = float((ordered[:peaks] - threshold).mean())
        return cls(threshold, max(excess, MIN_SCALE), peaks / len(maxima), peaks)

    def upper_confidence_level(self, probability: float) -> float:
        """Upper end of the one-sided 95 % interval of `level`, given the number of values behind the scale."""
        margin = 1.0 + NORMAL_95 / math.sqrt(max(self.peaks, 1))
        return self.threshold + margin * (self.level(probability) - self.threshold)

    def level(self, probability: float) -> float:
        """The value exceeded with this probability; the threshold, if the probability is above `share`."""
        return self.threshold + self.scale * max(math.log(self.share / probability), 0.0)
