"""Windows of healthy running: the largest limit factor at which each would have raised an alarm.

An alarm is raised when the score has been above its limit for the on-delay. So what counts of a window is not its
highest score but the highest that was held for that long.
"""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np

from schemas.messages import Array
from schemas.units import NS_PER_S

WINDOW_S = 10.0


class Windows:
    """Of one run of some fans. Rows of figures: the seven statistics, and the score, which is the largest of them."""

    def __init__(self, fans: int, on_delay_s: float) -> None:
        self._on_delay_s = on_delay_s
        self._origin_t_ns: int | None = None
        self._number = 0
        self._held = _Held()
        self._maxima = np.full((8, fans), -np.inf)
        self._done: list[Array] = []

    def add(self, t_ns: Array, period_ns: int, ratios: Array, judged: Array) -> None:
        """Take a block. t_ns: (n,). ratios: (7, n, fans). judged: (n, fans)."""
        if self._origin_t_ns is None:
            self._origin_t_ns = int(t_ns[0])
        rows = math.ceil(round(self._on_delay_s * NS_PER_S) / period_ns) + 1
        held = self._held.update(np.concatenate((ratios, ratios.max(axis=0, keepdims=True))), judged, rows)
        numbers = (t_ns - self._origin_t_ns) // round(WINDOW_S * NS_PER_S)
        edges = [0, *(np.flatnonzero(np.diff(numbers)) + 1).tolist(), len(numbers)]
        for first, last in pairwise(edges):
            if numbers[first] != self._number:
                self._close()
                self._number = int(numbers[first])
            np.maximum(self._maxima, held[:, first:last].max(axis=1), out=self._maxima)

    def end(self) -> Array:
        """(windows, 8, fans); NaN where a fan was not judged."""
        self._close()
        return np.stack(self._done) if self._done else np.zeros((0, *self._maxima.shape))

    def _close(self) -> None:
        if np.isfinite(self._maxima).any():
            self._done.append(np.where(np.isfinite(self._maxima), self._maxima, np.nan))
        self._maxima[:] = -np.inf


class _Held:
    """The least of the last so many samples; those that are not judged do not count, as an on-delay leaves them out."""

    def __init__(self) -> None:
        self._last = np.zeros((8, 0, 1))

    def update(self, figures: Array, judged: Array, rows: int) -> Array:
        """(8, n, fans), -inf where not judged. figures: (8, n, fans). judged: (n, fans)."""
        missing = rows - 1 - self._last.shape[1]
        last = np.broadcast_to(self._last, (8, self._last.shape[1], figures.shape[2]))[:, max(0, -missing) :]
        before = np.concatenate((np.zeros((8, max(0, missing), figures.shape[2])), last), axis=1)
        least = np.concatenate((before, np.where(judged, figures, np.inf)), axis=1)
        self._last = least[:, least.shape[1] - (rows - 1) :]
        span = 1
        while span < rows:
            shift = min(span, rows - span)
            least = np.minimum(least[:, shift:], least[:, :-shift])
            span += shift
        return np.where(judged, least, -np.inf)


def peaks(maxima: Array) -> Array:
    """Where an excursion over several windows counts: in its highest one. maxima: (windows, fans), NaN if not judged.

    Zero in the others.
    """
    level = np.pad(np.nan_to_num(maxima), ((1, 1), (0, 0)))
    highest = (level[1:-1] > level[:-2]) & (level[1:-1] >= level[2:])
    return np.where(highest | np.isnan(maxima), maxima, 0.0)
