"""How far a twin may be wrong at each speed and command, as its card stores it."""

from __future__ import annotations

import numpy as np
from pydantic import ConfigDict, model_validator
from pydantic.dataclasses import dataclass


@dataclass(frozen=True, config=ConfigDict(extra="ignore", allow_inf_nan=False))
class ModelUncertainty:
    """Standard deviation of the twin's own error, as a table.

    speeds_rad_s, commands: rising. std_rad_s: (speeds, commands). With a drive, a command on its plateau is the end of
    the plateau.
    """

    speeds_rad_s: tuple[float, ...]
    commands: tuple[float, ...]
    std_rad_s: tuple[tuple[float, ...], ...]

    @model_validator(mode="after")
    def _check(self) -> ModelUncertainty:
        if any(len(axis) < 2 or np.diff(axis).min() <= 0.0 for axis in (self.speeds_rad_s, self.commands)):
            raise ValueError("speeds_rad_s and commands must be rising, two of each at least")
        shape = (len(self.speeds_rad_s), len(self.commands))
        if [len(row) for row in self.std_rad_s] != [shape[1]] * shape[0] or np.min(self.std_rad_s) < 0.0:
            raise ValueError("std_rad_s must have a row for each speed with a value for each command, none below zero")
        return self
