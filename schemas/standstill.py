"""How healthy fans stop, stand and start: one definition for the twin card, its maker and the runtime."""

from __future__ import annotations

from typing import ClassVar, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, model_validator

SLOWED_SHARE = 0.7
"""of its speed: a fan that still has more has not slowed down"""


class Standstill(BaseModel):
    """Found in the training runs, for all fans of a twin together. Commands in the unit of the card.

    The fans of a tray are alike, and each stops rarely: together they show more stops and starts than one by one.
    """

    model_config: ClassVar[ConfigDict] = ConfigDict(frozen=True, extra="ignore", allow_inf_nan=False)

    turning_command: float = Field(ge=0, description="lowest command at which every fan turned steadily")
    standing_below_rad_s: float = Field(gt=0, description="a lower reading is of a fan that stands or comes to rest")
    off_command: float | None = Field(
        default=None, ge=0, description="highest command at which fans stood for long; null: they never did"
    )
    start_s: float | None = Field(
        default=None, ge=0, description="longest time from a command to turn to a reading of a fan that turns"
    )
    coast_s: float | None = Field(
        default=None,
        ge=0,
        description="longest time from a command to stop, at full speed, to a reading of a fan at rest",
    )
    slowing_s: float | None = Field(
        default=None,
        ge=0,
        description="longest time from a command to stop to a reading of 70 % of the speed, less the mean delay of "
        "readings; null where none was seen",
    )
    coast_time_constant_s: float | None = Field(
        default=None, gt=0, description="typical time constant of a fan that coasts"
    )
    lapse_s: float = Field(
        default=0.0, ge=0, description="longest time for which the tacho of a fan that turned read as if it stood"
    )

    @model_validator(mode="after")
    def _off_is_below_turning(self) -> Self:
        if self.off_command is not None and self.off_command >= self.turning_command:
            raise ValueError("off_command must be below turning_command")
        return self

    def turns(self, speed_rad_s: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Which readings are of a fan that turns; no reading is of none."""
        return np.abs(speed_rad_s) >= self.standing_below_rad_s

    def drives(self, command: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Which commands turn a healthy fan."""
        return command >= self.turning_command

    def stops(self, command: NDArray[np.float64], speed_rad_s: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Which commands stop a fan.

        If fans were never seen to stand, a command of 0 below all that turned them stops a fan that reads no speed: one
        that turns at its minimum speed without a command is not called stopped.
        """
        if self.off_command is not None:
            return command <= self.off_command
        return (command <= 0.0) & ~self.drives(command) & ~self.turns(speed_rad_s)
