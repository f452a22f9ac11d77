"""How old the outputs of a stage were when they were sent: lately, and since the start."""

from __future__ import annotations

import math
import time
from bisect import bisect_left
from collections import deque
from itertools import accumulate

import numpy as np

from fantwin.schemas.health import LatencyBucket

LATENCY_WINDOW_S = 10.0
"""percentiles are those of the outputs of this long"""
UPPER_S = (0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 30.0, math.inf)
"""of the buckets of the histogram"""
_MAX_IN_WINDOW = 2000


class Latencies:
    """Latencies of the outputs of one stage: the time, s, from the newest sample of an output until it is sent."""

    def __init__(self) -> None:
        self._newest_s: deque[tuple[float, float]] = deque(maxlen=_MAX_IN_WINDOW)
        """with the time at which each was measured, of a monotonic clock"""
        self._counts = [0] * len(UPPER_S)
        self.sum_s = 0.0
        """of all; one that is negative, because two clocks differ, counts as zero"""

    def add(self, latency_s: float) -> None:
        """An output has been sent."""
        self._newest_s.append((time.monotonic(), latency_s))
        self._counts[bisect_left(UPPER_S, latency_s)] += 1
        self.sum_s += max(0.0, latency_s)

    def clear(self) -> None:
        """What was added until now was no latency."""
        self._newest_s.clear()
        self._counts = [0] * len(UPPER_S)
        self.sum_s = 0.0

    def percentiles_ms(self) -> tuple[float, float]:
        """Median and 99th percentile of the last LATENCY_WINDOW_S; zero if nothing was sent."""
        since_s = time.monotonic() - LATENCY_WINDOW_S
        newest_ms = [latency_s * 1e3 for at_s, latency_s in self._newest_s if at_s >= since_s]
        if not newest_ms:
            return 0.0, 0.0
        p50, p99 = np.percentile(newest_ms, (50, 99))
        return float(p50), float(p99)

    def histogram(self) -> tuple[LatencyBucket, ...]:
        """Of all; empty if nothing was sent."""
        if not any(self._counts):
            return ()
        counts = accumulate(self._counts)
        return tuple(
            LatencyBucket(upper_s=upper_s, count=count) for upper_s, count in zip(UPPER_S, counts, strict=True)
        )
