"""Successive intervals of the baselines, and the samples of each."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from schemas.messages import Array

ONE_START = np.zeros(1, np.int64)
MOST = 60  # scored together: of more, much would be scored again where the run has to end early


@dataclass(frozen=True, eq=False)
class Intervals:
    """Some successive intervals with samples; the last one may go on."""

    starts: Array
    """(intervals,) the first row of each"""
    rows: int
    """of all together"""
    expected: int
    """samples in an interval, if none is missing"""

    @classmethod
    def of(cls, numbers: Array, expected: int) -> Intervals:
        """The first MOST intervals of samples; numbers: (n,) the interval of each, rising."""
        if numbers[0] == numbers[-1]:
            return cls(ONE_START, len(numbers), expected)
        starts = np.concatenate(([0], np.flatnonzero(np.diff(numbers)) + 1))
        return cls(starts, len(numbers), expected).first(MOST)

    def __len__(self) -> int:
        return len(self.starts)

    @property
    def lengths(self) -> Array:
        """(intervals,) how many samples each has."""
        return np.diff(self.starts, append=self.rows)

    def first(self, count: int) -> Intervals:
        """The first of them."""
        if count >= len(self.starts):
            return self
        return Intervals(self.starts[:count], int(self.starts[count]), self.expected)

    def sums(self, values: Array) -> Array:
        """(intervals, ...) sums of integers (rows, ...) over each."""
        if self.rows == 1:
            return values.copy()
        return np.add.reduceat(values, self.starts, axis=0)

    def largest(self, values: Array) -> Array:
        """(intervals, ...) the largest of values (rows, ...) in each."""
        if self.rows == 1:
            return values
        return np.maximum.reduceat(values, self.starts, axis=0)

    def spread(self, of_each: Array) -> Array:
        """(rows, ...) for each sample what is (intervals, ...) of its interval."""
        if self.rows == 1:
            return of_each
        if len(self.starts) == 1:
            return np.broadcast_to(of_each, (self.rows, *of_each.shape[1:]))
        return np.repeat(of_each, self.lengths, axis=0)


def first_end(ends: Array) -> int:
    """How many intervals there are up to the first that ends a run, itself counted; ends: (intervals,) of bool."""
    return int(ends.argmax()) + 1 if ends.any() else len(ends)
