"""How far a twin may be wrong at each speed and command, as its card stores it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, model_validator
from pydantic.dataclasses import dataclass

from fantwin.schemas.fields import Array

Table: TypeAlias = tuple[tuple[float, ...], ...]


@dataclass(frozen=True, config=ConfigDict(extra="ignore", allow_inf_nan=False))
class ModelUncertainty:
    """Standard deviation of the twin's own error, one table for each fan.

    speeds_rad_s, commands: rising; the speeds are relative to those at which a fan settles at the commands, so that the
    table has points where fans are most of the time. settled_speed_rad_s: (fans, commands) the speeds at which each fan
    settles. std_rad_s: (fans, commands, speeds), rad/s; a card with a single table uses it for all fans. With a drive,
    a command on its plateau is the end of the plateau. seen_std_rad_s: (fans,) where a fan was held in training the
    standard deviation is hardly ever above this one.
    """

    speeds_rad_s: tuple[float, ...]
    commands: tuple[float, ...]
    std_rad_s: tuple[Table, ...]
    seen_std_rad_s: tuple[float, ...]
    settled_speed_rad_s: tuple[tuple[float, ...], ...]

    @model_validator(mode="after")
    def _check(self) -> ModelUncertainty:
        if any(len(axis) < 2 or np.diff(axis).min() <= 0.0 for axis in (self.speeds_rad_s, self.commands)):
            raise ValueError("speeds_rad_s and commands must be rising, two of each at least")
        shape = len(self.commands), len(self.speeds_rad_s)
        found = [[len(row) for row in table] for table in self.std_rad_s]
        if not found or found != [[shape[1]] * shape[0]] * len(found) or np.min(self.std_rad_s) < 0.0:
            raise ValueError("std_rad_s must have a value for each command and speed, none below zero")
        if [len(row) for row in self.settled_speed_rad_s] != [shape[0]] * len(found):
            raise ValueError("settled_speed_rad_s must have a speed for each command of each fan")
        if len(self.seen_std_rad_s) != len(found) or min(self.seen_std_rad_s) < 0.0:
            raise ValueError("seen_std_rad_s must have a value for each table, none below zero")
        return self

    def of_fans(self, rows: Sequence[int]) -> ModelUncertainty:
        """The tables of the fans in these rows; a single table for all fans is returned as it is."""
        if len(self.std_rad_s) == 1:
            return self
        names = "std_rad_s", "seen_std_rad_s", "settled_speed_rad_s"
        of_all = {name: getattr(self, name) for name in names}
        return replace(self, **{name: tuple(of[row] for row in rows) for name, of in of_all.items()})

    def std_at(self, speed_rad_s: Array, command: Array) -> Array:
        """Standard deviation, rad/s, at speeds and commands of one shape, whose last axis is over the fans; NaN where
        either is NaN.

        Linear between the points of the table, constant beyond its edges.
        """
        return self._between(*self._places(speed_rad_s, command))

    def over(self, speeds_rad_s: Array, commands: Array) -> Array:
        """(speeds, commands) of one fan at all pairs of speeds and commands, (n,) each."""
        speed_rad_s, command = np.meshgrid(speeds_rad_s, commands, indexing="ij")
        return self.std_at(speed_rad_s[..., np.newaxis], command[..., np.newaxis])[..., 0]

    def unseen_std_at(self, speed_rad_s: Array, command: Array) -> Array:
        """What of it adds to the errors that training has seen, rad/s: 0 at most samples at which the fan was held."""
        row, column = self._places(speed_rad_s, command)
        cell = self._first_cell + row.before * (len(self.speeds_rad_s) - 1) + column.before
        if not self._has_unseen.take(cell).any():
            return np.zeros(speed_rad_s.shape)  # as nearly always
        unseen = np.sqrt(np.maximum(self._between(row, column) ** 2 - self._seen_squared, 0.0))
        return np.where(self._has_unseen.take(cell), unseen, 0.0)  # whatever the other fans and samples are

    def _places(self, speed_rad_s: Array, command: Array) -> tuple[_Place, _Place]:
        """On the axes of rows and of columns."""
        row = _place(command, *self._row_axis)
        at = self._first_row + row.before
        before = self._settled.take(at)
        settled_rad_s = before + row.share * (self._settled.take(at + 1) - before)
        return row, _place(speed_rad_s - settled_rad_s, *self._column_axis)

    def _between(self, row: _Place, column: _Place) -> Array:
        width, table = len(self.speeds_rad_s), self._tables
        at = self._first_point + row.before * width + column.before
        lower = table.take(at) + column.share * (table.take(at + 1) - table.take(at))
        upper = table.take(at + width) + column.share * (table.take(at + width + 1) - table.take(at + width))
        return lower + row.share * (upper - lower)

    @cached_property
    def _tables(self) -> Array:
        return np.array(self.std_rad_s)

    @cached_property
    def _seen_squared(self) -> Array:
        return np.array([each**2 for each in self.seen_std_rad_s])  # np.square differs in the last digit

    @cached_property
    def _settled(self) -> Array:
        return np.array(self.settled_speed_rad_s)

    @cached_property
    def _first_row(self) -> NDArray[np.intp]:
        """(fans or 1,) where the rows of each table begin."""
        return np.arange(len(self._tables)) * len(self.commands)

    @cached_property
    def _first_point(self) -> NDArray[np.intp]:
        """(fans or 1,) where the table of each fan begins."""
        return self._first_row * len(self.speeds_rad_s)

    @cached_property
    def _first_cell(self) -> NDArray[np.intp]:
        """(fans or 1,) where the cells between the points of each table begin."""
        return np.arange(len(self._tables)) * (len(self.commands) - 1) * (len(self.speeds_rad_s) - 1)

    @cached_property
    def _has_unseen(self) -> NDArray[np.bool_]:
        """(cells,) whether a corner of the cell between four points of a table is above what training has seen."""
        above = self._tables > np.array(self.seen_std_rad_s)[:, np.newaxis, np.newaxis]
        of_cells = above[:, 1:, 1:] | above[:, 1:, :-1] | above[:, :-1, 1:] | above[:, :-1, :-1]
        return of_cells.ravel()

    @cached_property
    def _row_axis(self) -> tuple[Array, Array]:
        return _axis(self.commands)

    @cached_property
    def _column_axis(self) -> tuple[Array, Array]:
        return _axis(self.speeds_rad_s)


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
