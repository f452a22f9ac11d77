"""The grid of a tray: its rate, as it follows from that of the line, the longest gap that is bridged, and how long a
sample is waited for.

The rate is taken from a short ladder, so that a resampler that is started again comes to the same one: two measurements
of one line differ by a few per cent, the steps of the ladder by 25 % or more.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from fantwin.schemas.units import NS_PER_S

PERIODS_S = (60, 30, 20, 15, 10, 5, 3, 2)
"""sample periods of grids slower than 1 Hz: how often systems of monitoring look"""
RATES_HZ = (*(1 / period_s for period_s in PERIODS_S), 1, 2, 5, 10, 20, 25, 50, 100)
"""rates of a grid that follows from the line; a faster line gets the last one"""
GAP_PERIODS = 5.0
"""length of a gap that is bridged, in sample periods"""
FEWEST_PERIODS = 1.5  # of a gap limit: with fewer, samples that are a little late are gaps
SHORTEST_GAP_S = 0.1
WATERMARK_S = 0.5
STALE_FOR_S = 5.0
SLOWER = 1.2
"""ratio by which the slowest line that can be judged may be slower than the slowest grid"""


@dataclass(frozen=True)
class GridTiming:
    """The times of a grid, all in ns: see the settings of `[resampler]`."""

    period_ns: int
    gap_limit_ns: int
    watermark_ns: int
    stale_for_ns: int

    @property
    def rate_hz(self) -> float:
        """Grid samples a second."""
        return NS_PER_S / self.period_ns


def grid_timing(rate_hz: float, gap_limit_s: float | None, watermark_s: float | None) -> GridTiming:
    """The times of a grid of this rate. What is None follows from the rate and from the limit that is given.

    The gap limit is five periods, at least 0.1 s, and not above a watermark that is given. The watermark is at least
    the gap limit, and the grid ends after at least twice the watermark.
    """
    if gap_limit_s is None:
        gap_limit_s = min(max(SHORTEST_GAP_S, GAP_PERIODS / rate_hz), math.inf if watermark_s is None else watermark_s)
    if watermark_s is None:
        watermark_s = max(WATERMARK_S, gap_limit_s)
    return GridTiming(
        period_ns=round(NS_PER_S / rate_hz),
        gap_limit_ns=round(gap_limit_s * NS_PER_S),
        watermark_ns=round(watermark_s * NS_PER_S),
        stale_for_ns=round(max(STALE_FOR_S, 2.0 * watermark_s) * NS_PER_S),
    )


def grid_rate_hz(line_hz: float) -> float:
    """The rate on the ladder that is nearest to that of a line, by ratio."""
    bounds = [math.sqrt(low * high) for low, high in pairwise(RATES_HZ)]
    return RATES_HZ[int(np.searchsorted(bounds, line_hz))]


def is_too_slow(line_hz: float) -> bool:
    """Return whether a line is slower than the slowest grid can be."""
    return line_hz < RATES_HZ[0] / SLOWER


def leaves_gaps(line_hz: float, timing: GridTiming) -> bool:
    """Return whether the samples of a line are so far apart that many of the spans between them count as gaps."""
    return line_hz * timing.gap_limit_ns < FEWEST_PERIODS * NS_PER_S
