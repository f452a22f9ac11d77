"""What a twin carries from one sample to the next."""

from dataclasses import dataclass

import numpy as np

from twin.runs import Array


@dataclass(frozen=True)
class StateLayout:
    """A state of (fans, speed + command) numbers: past speeds, newest first, then past commands, newest first."""

    speed: int
    command: int

    @property
    def size(self) -> int:
        """The numbers of state per fan."""
        return self.speed + self.command

    def initial_state(self, speed_rad_s: Array, command: Array) -> Array:
        """(fans, size) state of fans that have run at speed_rad_s (fans,) under command (fans,) for long."""
        return np.column_stack((np.tile(speed_rad_s, (self.speed, 1)).T, np.tile(command, (self.command, 1)).T))

    def measured_state(self, speed_rad_s: Array, command: Array, sample: int) -> Array:
        """(fans, size) state at one sample of a run (n, fans). Raises IndexError before enough samples have passed."""
        if sample < max(self.speed - 1, self.command):
            raise IndexError(f"sample {sample} has no {self.speed} speeds and {self.command} commands before it")
        speeds = speed_rad_s[sample - self.speed + 1 : sample + 1][::-1]
        commands = command[sample - self.command : sample][::-1]
        return np.column_stack((speeds.T, commands.T))


ODE_LAYOUT = StateLayout(speed=1, command=0)
