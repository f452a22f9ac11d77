"""Windows of healthy data: the highest value of each statistic that would have raised an alarm.

An alarm is raised when the score has been above its limit for the on-delay. So the relevant value of a window is not
its maximum but the highest value that was held for that long.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from schemas.messages import Array
from schemas.units import NS_PER_S

WINDOW_S = 10.0


@dataclass(frozen=True, eq=False)
class WindowMaxima:
    """The maxima of one run, in multiples of the limits; NaN where a fan was not scored."""

    statistics: Array
    """(windows, rows of the table of detectors, fans)"""
    score: Array
    """(windows, fans) of the largest of all statistics"""


class Windows:
    """The maxima of a run as its blocks come in."""

    def __init__(self, fans: int, statistics: int, on_delay_s: float) -> None:
        self._on_delay_s = on_delay_s
        self._origin_t_ns: int | None = None
        self._number = 0
        self._held = _Held(statistics + 1)
        self._maxima = np.full((statistics + 1, fans), -np.inf)
        self._done: list[Array] = []

    def add(self, t_ns: Array, period_ns: int, ratios: Array, scored: Array) -> None:
        """Take a block. t_ns: (n,). ratios: (statistics, n, fans). scored: (n, fans) of bool."""
        if self._origin_t_ns is None:
            self._origin_t_ns = int(t_ns[0])
        rows = math.ceil(round(self._on_delay_s * NS_PER_S) / period_ns) + 1
        held = self._held.update(np.concatenate((ratios, ratios.max(axis=0, keepdims=True))), scored, rows)
        numbers = (t_ns - self._origin_t_ns) // round(WINDOW_S * NS_PER_S)
        edges = [0, *(np.flatnonzero(np.diff(numbers)) + 1).tolist(), len(numbers)]
        for first, last in pairwise(edges):
            if numbers[first] != self._number:
                self._close()
                self._number = int(numbers[first])
            np.maximum(self._maxima, held[:, first:last].max(axis=1), out=self._maxima)

    def end(self) -> WindowMaxima:
        """The maxima of all windows in which any fan was scored."""
        self._close()
        maxima = np.stack(self._done) if self._done else np.zeros((0, *self._maxima.shape))
        return WindowMaxima(statistics=maxima[:, :-1], score=maxima[:, -1])

    def _close(self) -> None:
        if np.isfinite(self._maxima).any():
            self._done.append(np.where(np.isfinite(self._maxima), self._maxima, np.nan))
        self._maxima[:] = -np.inf


class _Held:
    """The minimum over the last samples that were scored: an on-delay leaves out the others."""

    def __init__(self, figures: int) -> None:
        self._last = np.zeros((figures, 0, 1))

    def update(self, figures: Array, scored: Array, rows: int) -> Array:
        """(figures, n, fans) of (figures, n, fans), over `rows` samples; -inf where not scored, (n, fans)."""
        count, _, fans = figures.shape
        missing = rows - 1 - self._last.shape[1]
        last = np.broadcast_to(self._last, (count, self._last.shape[1], fans))[:, max(0, -missing) :]
        before = np.concatenate((np.zeros((count, max(0, missing), fans)), last), axis=1)
        least = np.concatenate((before, np.where(scored, figures, np.inf)), axis=1)
        self._last = least[:, least.shape[1] - (rows - 1) :]
        span = 1
        while span < rows:
            shift = min(span, rows - span)
            least = np.minimum(least[:, shift:], least[:, :-shift])
            span += shift
        return np.where(scored, least, -np.inf)


def peaks(maxima: Array) -> Array:
    """Maxima (windows, fans) in which an excursion over several windows counts once, in its highest one.

    The other windows of it are zero. NaN where a fan was not scored.
    """
    level = np.pad(np.nan_to_num(maxima), ((1, 1), (0, 0)))
    highest = (level[1:-1] > level[:-2]) & (level[1:-1] >= level[2:])
    return np.where(highest | np.isnan(maxima), maxima, 0.0)
