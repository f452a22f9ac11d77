"""How far a twin may be wrong at each speed and command, as its card stores it."""

from __future__ import annotations

from functools import cached_property
from typing import NamedTuple

import numpy as np
from pydantic import ConfigDict, model_validator
from pydantic.dataclasses import dataclass

from schemas.fields import Array


@dataclass(frozen=True, config=ConfigDict(extra="ignore", allow_inf_nan=False))
class ModelUncertainty:
    """Standard deviation of the twin's own error, as a table.

    speeds_rad_s, commands: rising. std_rad_s: (speeds, commands). With a drive, a command on its plateau is the end of
    the plateau. seen_std_rad_s: where the twin was trained the standard deviation is hardly ever above this one; None
    in early cards.
    """

    speeds_rad_s: tuple[float, ...]
    commands: tuple[float, ...]
    std_rad_s: tuple[tuple[float, ...], ...]
    seen_std_rad_s: float | None = None

    @model_validator(mode="after")
    def _check(self) -> ModelUncertainty:
        if any(len(axis) < 2 or np.diff(axis).min() <= 0.0 for axis in (self.speeds_rad_s, self.commands)):
            raise ValueError("speeds_rad_s and commands must be rising, two of each at least")
        shape = (len(self.speeds_rad_s), len(self.commands))
        if [len(row) for row in self.std_rad_s] != [shape[1]] * shape[0] or np.min(self.std_rad_s) < 0.0:
            raise ValueError("std_rad_s must have a row for each speed with a value for each command, none below zero")
        if self.seen_std_rad_s is not None and self.seen_std_rad_s < 0.0:
            raise ValueError("seen_std_rad_s must not be below zero")
        return self

    def std_at(self, speed_rad_s: Array, command: Array) -> Array:
        """Standard deviation, rad/s, at speeds and commands of one shape; NaN where either is.

        Linear between the points of the table, constant beyond its edges.
        """
        return self._between(_place(speed_rad_s, *self._speed_axis), _place(command, *self._command_axis))

    def unseen_std_at(self, speed_rad_s: Array, command: Array) -> Array:
        """What of it adds to the errors that training has seen, rad/s: 0 where the twin was trained."""
        row, column = _place(speed_rad_s, *self._speed_axis), _place(command, *self._command_axis)
        if self.seen_std_rad_s is None or not self._has_unseen.take(row.before * self._cells + column.before).any():
            return np.zeros(speed_rad_s.shape)  # as nearly always
        return np.sqrt(np.maximum(self._between(row, column) ** 2 - self.seen_std_rad_s**2, 0.0))

    def _between(self, row: _Place, column: _Place) -> Array:
        at, width, table = row.before * len(self.commands) + column.before, len(self.commands), self._table
        lower = table.take(at) + column.share * (table.take(at + 1) - table.take(at))
        upper = table.take(at + width) + column.share * (table.take(at + width + 1) - table.take(at + width))
        return lower + row.share * (upper - lower)

    @cached_property
    def _table(self) -> Array:
        return np.array(self.std_rad_s)

    @cached_property
    def _has_unseen(self) -> Array:
        """(cells,) whether a corner of the cell between four points of the table is above what training has seen."""
        above = self._table > (self.seen_std_rad_s or 0.0)
        return (above[1:, 1:] | above[1:, :-1] | above[:-1, 1:] | above[:-1, :-1]).ravel()

    @property
    def _cells(self) -> int:
        return len(self.commands) - 1

    @cached_property
    def _speed_axis(self) -> tuple[Array, Array]:
        return _axis(self.speeds_rad_s)

    @cached_property
    def _command_axis(self) -> tuple[Array, Array]:
        return _axis(self.commands)


class _Place(NamedTuple):
    """Where values are on an axis: the point before each, and the share of the way to the next one; NaN for NaN."""

    before: Array
    share: Array


def _axis(points: tuple[float, ...]) -> tuple[Array, Array]:
    return np.array(points), np.arange(len(points), dtype=np.float64)


def _place(values: Array, points: Array, numbers: Array) -> _Place:
    place = np.interp(values, points, numbers)
    before = np.fmin(place, numbers[-2]).astype(np.intp)
    return _Place(before, place - before)
