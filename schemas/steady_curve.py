"""Steady speed over the command of a static twin, and how far readings after a change may be from what it expects."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
SLOWER = 2.0
"""factor by which a fan may be slower at some speeds than its one time constant"""


@dataclass(frozen=True, eq=False)
class SteadyCurve:
    """Curves of some fans. commands: (K,) rising; speeds_rad_s: (fans, K); time_constant_s: (fans,)."""

    commands: Array
    speeds_rad_s: Array
    time_constant_s: Array

    def speed_rad_s(self, command: Array) -> Array:
        """(n, fans) the steady speeds of commands (n, fans); beyond the last ones the curve goes on straight."""
        place = np.clip(np.searchsorted(self.commands, command, side="right") - 1, 0, len(self.commands) - 2)
        share = (command - self.commands[place]) / np.diff(self.commands)[place]
        fans = np.arange(command.shape[1])
        low, high = self.speeds_rad_s[fans, place], self.speeds_rad_s[fans, place + 1]
        return low + share * (high - low)

    def half_range_rad_s(self, command: Array, step_s: Array, before: Array) -> Array:
        """(n, fans) how far each reading may be from the one expected: a command may have changed at any time since the
        sample before, and what a fan lacks then decays.

        command: (n + 1, fans), from the sample before on. step_s: (n,) before each. before: (fans,) what was returned
        of the sample before.
        """
        found = np.abs(np.diff(self.speed_rad_s(command), axis=0))
        for row, seconds in enumerate(step_s):
            before = found[row] + np.exp(-seconds / (SLOWER * self.time_constant_s)) * before
            found[row] = before
        return found
