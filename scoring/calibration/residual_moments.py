"""Sums over the residual of healthy runs, from which its mean, standard deviation and correlation time are computed."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields

import numpy as np

from schemas.messages import Array
from scoring.baseline.fan_offsets import Cells

SPEED_BINS = 24
MOTION_BINS = 12  # each twice as far as the one before; the last begins at the top speed
LARGEST_SQUARE, PARTS_OF_OCTAVE, OCTAVE_PARTS = 1e4, 8, 320
MEDIAN_OF_SQUARE = 0.4549  # of a normal variable of variance one


def _zeros(*shape: int) -> Array:
    return field(default_factory=lambda: np.zeros(shape))


@dataclass
class ResidualMoments:
    """Of one residual, less the expected residual and the baseline, sigma."""

    count: Array = _zeros(SPEED_BINS)
    total: Array = _zeros(SPEED_BINS)
    square: Array = _zeros(SPEED_BINS)
    cells: list[Cells] = field(default_factory=list)
    """of each run with fans that the twin knows"""
    of_fans: dict[tuple[str, int], Array] = field(default_factory=dict)
    """by the tray and the number of a fan, (2, SPEED_BINS) counts and sums; no tray where the twin knows its fans"""
    baselines: list[Array] = field(default_factory=list)
    """commissioned baselines of the fans of each run"""
    seconds: int = 0
    """number of one-second means"""
    second_mean_square: float = 0.0
    """sum of the squares of these means"""
    by_motion: Array = _zeros(3, MOTION_BINS)
    """over bins of motion: counts, sums of the squares of motion, and of the low-passed residual"""
    smoothed_by_speed: Array = _zeros(2, SPEED_BINS)
    """over bins of speed: counts, and sums of the squares of the smoothed statistic in its limit"""
    second_octaves: Array = _zeros(OCTAVE_PARTS)
    """histogram of the squares of one-second means, by parts of an octave below the largest square"""
    standardised_octaves: Array = _zeros(OCTAVE_PARTS)
    """the same of the standardised residual; of tachos that count, of means over ten counts"""

    def add(self, other: ResidualMoments) -> None:
        """Add the sums of other runs."""
        for one in fields(self):
            mine, others = getattr(self, one.name), getattr(other, one.name)
            if isinstance(mine, dict):
                for fan, sums in others.items():
                    mine[fan] = mine.get(fan, 0.0) + sums
            else:  # an array, a number, or a list with an item for each run
                setattr(self, one.name, mine + others)

    def mean_second_square(self) -> float:
        """Mean square of the one-second means: what baselines leave."""
        return self.second_mean_square / self.seconds if self.seconds else math.inf

    def typical_second_square(self) -> float:
        """The same by the median, as if normal: transients, which are rare and large, do not affect it."""
        return _quantile(self.second_octaves, 0.5) / MEDIAN_OF_SQUARE

    def mean_quantile(self, share: float) -> float:
        """The value that a share of the means of the standardised residual does not exceed."""
        return math.sqrt(_quantile(self.standardised_octaves, share))


def octaves(squares: Array) -> Array:
    """(OCTAVE_PARTS,) histogram of squares, by parts of an octave below the largest."""
    parts = PARTS_OF_OCTAVE * np.log2(LARGEST_SQUARE / np.clip(squares, 1e-12, LARGEST_SQUARE))
    return np.bincount(np.minimum(parts, OCTAVE_PARTS - 1).astype(int), minlength=OCTAVE_PARTS)


def _quantile(histogram: Array, share: float) -> float:
    if not histogram.sum():
        return math.inf
    parts = np.interp(1.0 - share, np.cumsum(histogram) / histogram.sum(), np.arange(OCTAVE_PARTS) + 1.0)
    return float(LARGEST_SQUARE * 0.5 ** (parts / PARTS_OF_OCTAVE))
