"""Samples of a range of time reduced to as many points as a plot can show: the least, mean and largest value of each
equal part of the range, so that a single odd sample is not lost."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fantwin.pipeline.site.trace import BRIDGED_PERIODS
from fantwin.schemas.messages import Array


@dataclass(frozen=True, eq=False)
class Points:
    """t_ns (n,), the others (n, columns); NaN where nothing is known. In each gap is a row of NaN."""

    t_ns: Array
    low: Array
    mean: Array
    high: Array


class Buckets:
    """A range of time in equal parts."""

    def __init__(self, begin_ns: int, end_ns: int, points: int, columns: int, least_ns: int = 1) -> None:
        """least_ns: least width of a part."""
        self._begin_ns, self._end_ns = begin_ns, end_ns
        self.width_ns = max(least_ns, -(-(end_ns - begin_ns) // points))
        shape = -(-(end_ns - begin_ns) // self.width_ns), columns
        self._low, self._high = np.full(shape, np.nan), np.full(shape, np.nan)
        self._total, self._count = np.zeros(shape), np.zeros(shape, np.int64)
        self._offset_ns, self._samples = np.zeros(shape[0]), np.zeros(shape[0], np.int64)
        self._period_ns = 0
        """the longest time between two samples, among those that are usual"""

    def add(self, t_ns: Array, mean: Array, low: Array | None = None, high: Array | None = None) -> None:
        """Add samples, t_ns (n,) and values (n, columns); low, high: where each stands for several."""
        if len(t_ns) > 1:
            self._period_ns = max(self._period_ns, int(np.median(np.diff(t_ns))))
        order = np.argsort(t_ns, kind="stable")
        order = order[(t_ns[order] >= self._begin_ns) & (t_ns[order] < self._end_ns)]
        if not len(order):
            return
        offset_ns = t_ns[order] - self._begin_ns
        part = offset_ns // self.width_ns
        values = mean[order]
        self._merge(part, values, *(values if each is None else each[order] for each in (low, high)))
        firsts = np.flatnonzero(np.diff(part, prepend=-1))
        self._offset_ns[part[firsts]] += np.add.reduceat(offset_ns.astype(np.float64), firsts)
        self._samples[part[firsts]] += np.diff(firsts, append=len(part))

    def add_spans(self, since_ns: Array, until_ns: Array, mean: Array, low: Array, high: Array) -> None:
        """Add values that stand for spans of time, to each part that has samples in it. (n,) and (n, columns)."""
        first, last = ((each - self._begin_ns) // self.width_ns for each in (since_ns, until_ns))
        row = np.repeat(np.arange(len(first)), last - first + 1)
        part = first[row] + np.arange(len(row)) - np.searchsorted(row, row)
        order = np.argsort(part, kind="stable")
        order = order[(part[order] >= 0) & (part[order] < len(self._samples))]
        if len(order):
            row = row[order]
            self._merge(part[order], mean[row], low[row], high[row])

    def _merge(self, part: Array, mean: Array, low: Array, high: Array) -> None:
        """Add values to parts; part: the number of each row's, ascending."""
        firsts = np.flatnonzero(np.diff(part, prepend=-1))
        at = part[firsts]
        self._low[at] = np.fmin(self._low[at], np.fmin.reduceat(low, firsts, axis=0))
        self._high[at] = np.fmax(self._high[at], np.fmax.reduceat(high, firsts, axis=0))
        self._total[at] += np.add.reduceat(np.nan_to_num(mean), firsts, axis=0)
        self._count[at] += np.add.reduceat(np.isfinite(mean).astype(np.int64), firsts, axis=0)

    def points(self) -> Points:
        """A point for each part that has samples, at their mean time, and a row of NaN in each gap."""
        has = self._samples > 0
        t_ns = self._begin_ns + (self._offset_ns[has] / self._samples[has]).astype(np.int64)
        with np.errstate(invalid="ignore"):
            mean = self._total[has] / np.where(self._count[has], self._count[has], np.nan)
        longest_ns = BRIDGED_PERIODS * max(self._period_ns, self.width_ns)
        holes = np.flatnonzero(np.diff(t_ns) > longest_ns) + 1
        between = (t_ns[holes - 1] + t_ns[holes]) // 2
        low, mean, high = (np.insert(each, holes, np.nan, axis=0) for each in (self._low[has], mean, self._high[has]))
        return Points(np.insert(t_ns, holes, between), low, mean, high)
