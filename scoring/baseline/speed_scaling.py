"""How the offset of a fan changes with its speed.

Friction that differs from day to day shifts the torque balance by a constant (exponent 0). Another density of the air
changes the drag, so the balance is off in proportion to the square of the speed (exponent 2), and the speed is off by
that divided by the slope of the needed command over speed, viscous + 2 drag w. The slope is constant at low speeds and
proportional to w at high ones, with the crossover at w = viscous / (2 drag).
"""

from __future__ import annotations

import numpy as np

from schemas.messages import Array
from scoring.baseline.settings import BaselineSettings

MAX_RELATIVE_SPEED = 3.0  # times the reference speed: above it, the offset is assumed not to grow further


def speed_scaling(settings: BaselineSettings, speed_rad_s: Array, valid: Array) -> Array:
    """(n, fans) the offset at these speeds (n, fans), relative to that at the reference speed."""
    if settings.speed_exponent == 0:
        return np.ones(speed_rad_s.shape)
    relative = np.where(valid, np.abs(speed_rad_s), 0.0) / settings.reference_speed_rad_s
    speed = np.minimum(relative, MAX_RELATIVE_SPEED)
    if settings.crossover_speed_rad_s is None:
        return speed**settings.speed_exponent
    crossover = settings.crossover_speed_rad_s / settings.reference_speed_rad_s
    return speed**settings.speed_exponent * (1.0 + crossover) / (speed + crossover)
