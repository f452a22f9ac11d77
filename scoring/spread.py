"""Growth of the residual's variance: what shakes a fan to and fro and leaves its mean where it was.

The root of the low-passed square of what the residual has beyond its own low-pass, in sigma. Vibration, a loose blade
and a noisy tacho all raise it.
"""

from __future__ import annotations

import numpy as np

from schemas.messages import Array
from scoring.low_pass import LowPass

TIME_CONSTANT_S = 1.0


class Spread:
    """Of a tray's fans."""

    def __init__(self, fans: int) -> None:
        self.square = LowPass(fans, TIME_CONSTANT_S)

    def reset(self, fans: Array) -> None:
        """Begin anew for some fans, (fans,) of bool; from zero, for only growth matters."""
        self.square.reset(fans)

    def update(self, z: Array, smoothed: Array, valid: Array, step_s: float) -> Array:
        """Take a block, (n, fans) each: the standardised residual and its low-pass. Returns the spread in sigma."""
        return np.sqrt(self.square.update(np.where(valid, z - smoothed, 0.0) ** 2, valid, step_s))
