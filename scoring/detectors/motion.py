"""How much a fan is being moved: how far its speed is from what it was over the last second.

A twin that is right where the speed holds is a little wrong on the way from one speed to another. A healthy residual
varies the more, the further it went (an adaptive threshold by the size of the input: Emami-Naeini, Akhter and Rock,
IEEE Transactions on Automatic Control 33 (1988) 1106).
"""

from __future__ import annotations

import numpy as np

from schemas.messages import Array
from scoring.detectors.low_pass import LowPass

MEMORY_S = 1.0


class Motion:
    """Of a tray's fans."""

    def __init__(self, fans: int) -> None:
        self.past = LowPass(fans, MEMORY_S, np.nan)
        """rad/s; NaN before the first reading"""

    def update(self, speed_rad_s: Array, step_s: float) -> Array:
        """(n, fans) rad/s, for as many speeds; none where there is no reading."""
        valid = np.isfinite(speed_rad_s)
        new = np.isnan(self.past.value) & valid.any(axis=0)
        if new.any():
            first = valid[:, new].argmax(axis=0)
            self.past.value[new] = speed_rad_s[first, np.flatnonzero(new)]
        speed = np.where(valid, speed_rad_s, 0.0)
        return np.where(valid, np.abs(speed - self.past.update(speed, valid, step_s)), 0.0)
