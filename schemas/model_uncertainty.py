"""How far a twin may be wrong at each speed and command, as its card stores it."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, model_validator
from pydantic.dataclasses import dataclass

Array: TypeAlias = NDArray[np.float64]


@dataclass(frozen=True, config=ConfigDict(extra="ignore", allow_inf_nan=False))
class ModelUncertainty:
    """Standard deviation of the twin's own error: a table, linear between its points and constant beyond its edges.

    speeds_rad_s, commands: rising, evenly spaced. std_rad_s: (speeds, commands). With a drive, a command on its plateau
    is the end of the plateau.
    """

    speeds_rad_s: tuple[float, ...]
    commands: tuple[float, ...]
    std_rad_s: tuple[tuple[float, ...], ...]

    @model_validator(mode="after")
    def _check(self) -> ModelUncertainty:
        for axis in (self.speeds_rad_s, self.commands):
            steps = np.diff(axis)
            if len(axis) < 2 or steps.min() <= 0.0 or not np.allclose(steps, steps[0]):
                raise ValueError("speeds_rad_s and commands must be rising and evenly spaced, two of each at least")
        shape = (len(self.speeds_rad_s), len(self.commands))
        if [len(row) for row in self.std_rad_s] != [shape[1]] * shape[0] or np.min(self.std_rad_s) < 0.0:
            raise ValueError("std_rad_s must have a row for each speed with a value for each command, none below zero")
        return self

    def at(self, speed_rad_s: Array, command: Array) -> Array:
        """Standard deviation in rad/s at speeds and commands of one shape; NaN where either is."""
        std = np.array(self.std_rad_s)
        row, of_row = _cell(np.array(self.speeds_rad_s), speed_rad_s)
        column, of_column = _cell(np.array(self.commands), command)
        below = std[row, column] * (1.0 - of_column) + std[row, column + 1] * of_column
        above = std[row + 1, column] * (1.0 - of_column) + std[row + 1, column + 1] * of_column
        return below * (1.0 - of_row) + above * of_row


def _cell(axis: Array, values: Array) -> tuple[NDArray[np.intp], Array]:
    """In which cell of an axis each value lies, and how far along it, 0 to 1."""
    cells = ((values - axis[0]) / (axis[1] - axis[0])).clip(0.0, len(axis) - 1.0)
    first = np.minimum(np.nan_to_num(cells).astype(np.intp), len(axis) - 2)
    return first, cells - first
