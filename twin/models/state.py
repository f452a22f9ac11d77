"""What a twin carries from one sample to the next."""

from dataclasses import dataclass

import numpy as np

from twin.runs import Array


@dataclass(frozen=True)
class StateLayout:
    """A state of (fans, speed + command) numbers: past speeds, newest first, then past commands, newest first.

    The command part follows from the commands alone, whatever the speeds are.
    """

    speed: int
    command: int

    @property
    def size(self) -> int:
        """The numbers of state per fan."""
        return self.speed + self.command

    def initial_state(self, speed_rad_s: Array, command: Array) -> Array:
        """(fans, size) state of fans that have run at speed_rad_s (fans,) under command (fans,) for long."""
        return np.column_stack((np.tile(speed_rad_s, (self.speed, 1)).T, np.tile(command, (self.command, 1)).T))


ODE_LAYOUT = StateLayout(speed=1, command=1)
"""The one command is the lagged one (twin.models.lag): what is left of the commands before."""
