"""First-order low-pass over valid samples; an invalid sample leaves the output unchanged."""

from __future__ import annotations

import math

import numpy as np

from schemas.messages import Array
from scoring.column_state import ColumnState
from scoring.torque_balance import FEW_ROWS, by_rows, filter_rows, load_lfilter

MEMORY_TIME_CONSTANTS = 5.0  # after these, less than one percent of an output is left


class LowPass(ColumnState):
    """y[k] = keep y[k-1] + (1 - keep) x[k] with keep = exp(-step / time constant), exact for a held input."""

    def __init__(self, columns: int, time_constant_s: float, start: float = 0.0) -> None:
        load_lfilter()
        self._time_constant_s = time_constant_s
        self.value = np.full(columns, start)
        """(columns,) the last output"""

    @property
    def memory_s(self) -> float:
        """How long samples affect the output."""
        return MEMORY_TIME_CONSTANTS * self._time_constant_s

    def keep(self, period_s: float) -> float:
        """Weight of the previous output after one step."""
        return math.exp(-period_s / self._time_constant_s) if self._time_constant_s > 0 else 0.0

    def reset(self, columns: Array, to: float = 0.0) -> None:
        """Start again for some columns, (columns,) of bool."""
        self.value[columns] = to

    def update(self, x: Array, valid: Array, period_s: float) -> Array:
        """Take a block, (n, columns) each, and return the output after each sample."""
        keep = self.keep(period_s)
        is_whole = bool(valid.all())
        if len(x) <= FEW_ROWS or (not is_whole and by_rows(*x.shape)):
            return self._row_by_row(x, valid, keep)
        if is_whole:
            y, _ = filter_rows(keep, x, keep * self.value[np.newaxis])
        else:
            y = self._partly_valid(x, valid, keep)
        self.value = y[-1].copy()
        return y

    def _row_by_row(self, x: Array, valid: Array, keep: float) -> Array:
        """The same for a few rows, each in one go for all columns."""
        y = (1.0 - keep) * x
        if np.count_nonzero(valid) == valid.size:
            for row in y:
                self.value = np.add(row, keep * self.value, out=row)
            self.value = self.value.copy()
        else:
            for row, is_valid in zip(y, valid, strict=True):
                self.value = row[:] = np.where(is_valid, row + keep * self.value, self.value)
        return y

    def _partly_valid(self, x: Array, valid: Array, keep: float) -> Array:
        y = np.empty_like(x)
        whole = valid.all(axis=0)
        if whole.any():
            y[:, whole], _ = filter_rows(keep, x[:, whole], keep * self.value[np.newaxis, whole])
        y[:, ~whole] = self.value[~whole]
        for column in np.flatnonzero(~whole & valid.any(axis=0)).tolist():
            y[:, column] = self._held(x[:, column], valid[:, column], keep, self.value[column])
        return y

    def columns(self) -> dict[str, Array]:
        """See ColumnState."""
        return {"value": self.value}

    @staticmethod
    def _held(x: Array, valid: Array, keep: float, before: float) -> Array:
        rows = np.flatnonzero(valid)
        y, _ = filter_rows(keep, x[rows, np.newaxis], np.array([[keep * before]]))
        return np.concatenate(([before], y[:, 0]))[np.cumsum(valid)]
