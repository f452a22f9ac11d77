"""Faults as changes of the model of a healthy fan: a row each."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fantwin.schemas.messages import Array
from fantwin.scoring.model.operation import Fans, Inputs

DRAG, DRAG_GROWS, FRICTION, FRICTION_GROWS, DRIVE, SCALE, STUCK, RISES, FALLS = range(9)
OF_TACHO = slice(SCALE, STUCK + 1)
"""faults that change the reading and not the rotor"""
BEFORE_GROWTH = {DRAG_GROWS: DRAG, FRICTION_GROWS: FRICTION}
"""column that each growing fault multiplies by its age"""
COLUMNS = 9
GROWS_S = 60.0
"""unit of time of what grows"""
LARGEST_FRICTION = 10.0
"""largest effect of a friction, in multiples of the speed: it would be harmless at the top speed"""


@dataclass(frozen=True)
class Fault:
    """Cause and its signature. columns: of `forces`; std: prior standard deviations of their sizes, shares of the top
    speed (per GROWS_S if it grows; s for RISES and FALLS); sign: of the first size, 0 for either."""

    cause: str
    columns: tuple[int, ...]
    std: tuple[float, ...]
    sign: int
    mean: float
    """prior mean of the size of the first"""
    weight: float
    """prior probability, of a fan whose command is a torque: there the effect over the speed tells faults apart"""
    of_own_drive: float
    """prior of a fan that controls its speed by itself: there the effect over time tells them apart"""


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

UNSTEADY = ("unsteady", 0.05, (8.0, 30.0))
"""cause, prior probability, and additional variance of the readings in multiples of a healthy fan's: a fault without a
signature"""


def forces(fans: Fans, now: Inputs, age_s: Array, then_rad_s: Array, columns: int = COLUMNS) -> Array:
    """Effect (fans, onsets, columns) of a unit size of each column on the steady speed, or on the reading, rad/s.

    A torque moves the steady speed by itself over the slope of the torque that the fan needs; a weak drive takes a
    share of that and of what turns the rotor faster. Of a fan that controls its speed by itself drag takes a share of
    the speed. age_s: (onsets,) or (fans, onsets); then_rad_s: (fans, onsets), the speed at the onset; columns: how many
    of them, from the first.
    """
    speed, top = now.speed_rad_s, fans.top_rad_s
    steeper = fans.slope(top) / fans.slope(speed)
    needed = (fans.viscous + fans.drag * speed) * speed + fans.friction
    rate = np.where(now.is_balance, now.moves_rad_s2, now.rate_rad_s2)  # the measured speed is noisy
    torque = needed + np.where(fans.has_own_drive, 0.0, np.maximum(fans.inertia * rate, -needed))
    at_top = (fans.viscous + fans.drag * top) * top + fans.friction
    full = top * steeper
    of_fans = np.empty((len(speed), COLUMNS))
    of_drag = np.where(fans.has_own_drive, speed, steeper * speed**2 / top)
    of_fans[:, DRAG] = of_fans[:, DRAG_GROWS] = of_drag
    of_fans[:, FRICTION] = of_fans[:, FRICTION_GROWS] = np.minimum(full, LARGEST_FRICTION * speed)
    of_fans[:, DRIVE] = full * torque / at_top
    of_fans[:, SCALE] = np.where(now.is_balance, 0.0, now.moved_to_rad_s)
    of_fans[:, STUCK] = -of_fans[:, SCALE]
    of_fans[:, RISES], of_fans[:, FALLS] = np.minimum(-now.moves_rad_s2, 0.0), np.maximum(-now.moves_rad_s2, 0.0)
    over_ages = np.ones((*age_s.shape, columns))
    over_ages[..., DRAG_GROWS] = over_ages[..., FRICTION_GROWS] = age_s / GROWS_S
    made: Array = of_fans[:, np.newaxis, :columns] * over_ages
    made[:, :, STUCK] += np.where(now.is_balance[:, np.newaxis], 0.0, then_rad_s)
    return made
