"""Faults as changes of the model of a healthy fan: a row each."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bench.detection.one_model.operation import Fans, Inputs
from schemas.messages import Array

DRAG, DRAG_GROWS, FRICTION, FRICTION_GROWS, DRIVE, RISES, FALLS, SCALE, STUCK = range(9)
COLUMNS = 9
OF_TACHO = slice(SCALE, STUCK + 1)
"""what changes the reading and not the rotor"""
GROWS_S = 60.0
"""unit of time of what grows"""
LARGEST_FRICTION = 10.0
"""times the speed: what a friction that is harmless at the top speed does at a low one"""


@dataclass(frozen=True)
class Fault:
    """A cause, and how it shows: columns of `forces` with prior standard deviations of their sizes (shares of the top
    speed, in GROWS_S where it grows; s for RISES and FALLS), and the sign of the first (0: both)."""

    cause: str
    columns: tuple[int, ...]
    std: tuple[float, ...]
    sign: int
    mean: float
    """prior mean of the size of the first"""
    weight: float
    """prior probability, of a fan whose command is a torque: there the course over the speed tells one from another"""
    of_own_drive: float
    """and of one that controls its speed by itself: there the course over the time tells"""


FAULTS = (
    Fault("external_torque", (DRAG,), (0.12,), -1, 0.0, 0.0, 0.25),
    Fault("external_torque", (FRICTION,), (0.08,), -1, 0.0, 0.25, 0.10),
    Fault("drag_up", (DRAG,), (0.12,), -1, 0.0, 0.13, 0.0),
    Fault("drag_up", (DRAG_GROWS,), (0.02,), -1, 0.0, 0.10, 0.18),
    Fault("drag_up", (DRAG_GROWS,), (0.1,), -1, 0.0, 0.07, 0.10),
    Fault("friction_up", (DRAG, RISES, FALLS), (0.04, 0.6, 0.4), -1, 0.0, 0.0, 0.10),
    Fault("friction_up", (FRICTION_GROWS,), (0.05,), -1, 0.0, 0.15, 0.07),
    Fault("gain_down", (DRIVE,), (0.12,), -1, 0.0, 0.13, 0.08),
    Fault("drag_down", (DRAG,), (0.12,), +1, 0.0, 0.15, 0.10),
    Fault("sensor_scaling", (SCALE,), (0.2,), 0, 0.0, 0.02, 0.02),
    Fault("sensor_stuck", (STUCK,), (0.05,), 0, 1.0, 0.02, 0.02),
)


def forces(fans: Fans, now: Inputs, age_s: Array, then_rad_s: Array) -> Array:
    """(fans, onsets, COLUMNS) what each column of size 1 adds to what a fan tends to, rad/s, or to its reading.

    A torque moves the steady speed by itself over the slope of the torque that the fan needs; of a fan that controls
    its speed by itself drag takes a share of the speed. age_s: (onsets,); then_rad_s: (fans, onsets), the speed at the
    onset.
    """
    speed, top = now.speed_rad_s, fans.top_rad_s
    steeper = fans.slope(top) / fans.slope(speed)
    needed = (fans.viscous + fans.drag * speed) * speed + fans.friction
    at_top = (fans.viscous + fans.drag * top) * top + fans.friction
    of_friction = np.where(speed > 0.0, np.minimum(top * steeper, LARGEST_FRICTION * speed), 0.0)
    made = np.zeros((len(speed), len(age_s), COLUMNS))
    made[:, :, DRAG] = np.where(fans.has_own_drive, speed, steeper * speed**2 / top)[:, np.newaxis]
    made[:, :, FRICTION] = of_friction[:, np.newaxis]
    made[:, :, DRIVE] = (top * steeper * needed / at_top)[:, np.newaxis]
    grown = age_s / GROWS_S
    made[:, :, DRAG_GROWS], made[:, :, FRICTION_GROWS] = made[:, :, DRAG] * grown, made[:, :, FRICTION] * grown
    made[:, :, RISES] = -now.moves_rad_s2.clip(0.0)[:, np.newaxis]
    made[:, :, FALLS] = -now.moves_rad_s2.clip(None, 0.0)[:, np.newaxis]
    is_shown, moved_to = ~now.is_balance[:, np.newaxis], now.moved_to_rad_s[:, np.newaxis]
    made[:, :, SCALE], made[:, :, STUCK] = is_shown * moved_to, is_shown * (then_rad_s - moved_to)
    return made
