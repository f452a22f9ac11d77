"""Growth of the residual's variance: what shakes a fan to and fro and leaves its mean where it was.

The root of the low-passed square of what the residual has beyond its own low-pass, in sigma. Vibration, a loose blade
and a noisy tacho all raise it.
"""

from __future__ import annotations

import numpy as np

from schemas.messages import Array
from scoring.detectors.low_pass import LowPass

TIME_CONSTANT_S = 1.0


class Spread:
    """Of a tray's fans."""

    def __init__(self, fans: int, smoothing_s: float) -> None:
        self.mean = LowPass(fans, smoothing_s)
        self.square = LowPass(fans, TIME_CONSTANT_S)

    def reset(self, fans: Array) -> None:
        """Begin anew for some fans, (fans,) of bool; from zero, for only growth matters."""
        self.mean.reset(fans)
        self.square.reset(fans)

    def update(self, z: Array, valid: Array, step_s: float) -> Array:
        """Take a block of a standardised residual, (n, fans). Returns the spread in sigma."""
        beyond = np.where(valid, z - self.mean.update(z, valid, step_s), 0.0)
        return np.sqrt(self.square.update(beyond**2, valid, step_s))
