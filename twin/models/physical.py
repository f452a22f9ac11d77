"""The physical model: w' = (tau - alpha w - C_D w|w|) / J, three parameters per fan, and the unknowns it is fitted in.

What is fitted are logarithms of J, of the damping at rest and of the damping at top speed, and the lag. The damping
d torque / d speed is alpha + 2 C_D |w|. That it is positive at both ends makes the model stable at every recorded
speed, which is all that physics demands: C_D may come out negative where friction or a dead zone bends the curve.
"""

from typing import ClassVar

import numpy as np

from fantwin.twin.models.fan_ode import FanOde
from fantwin.twin.models.physics import LAG, PARAMETER_NAMES
from fantwin.twin.runs import Array


class PhysicalModel(FanOde):
    """Physics alone."""

    kind: ClassVar[str] = "physical"
    has_physics: ClassVar[bool] = True
    used_parameters: ClassVar[tuple[str, ...]] = PARAMETER_NAMES


def physical_parameters(unknowns: Array, top_speed_rad_s: Array) -> Array:
    """(fans, 4) J, alpha, C_D, lag_s. unknowns: (fans, 4). top_speed_rad_s: (fans,), the largest recorded.

    A lag below zero counts as zero.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        # A trial step may overflow; the fit then rejects it.
        inertia, at_rest, at_top = np.exp(unknowns.T[:LAG])
        drag = (at_top - at_rest) / (2.0 * top_speed_rad_s)
    # Adding zero makes a lag of -0.0 one of 0.0.
    return np.column_stack((inertia, at_rest, drag, np.maximum(unknowns[:, LAG], 0.0) + 0.0))


def parameters_by_unknowns(unknowns: Array, top_speed_rad_s: Array) -> Array:
    """(fans, 4, 4) derivatives of J, alpha, C_D, lag_s (rows) by the unknowns (columns)."""
    inertia, at_rest, at_top = np.exp(unknowns.T[:LAG])
    derivatives = np.zeros((len(unknowns), 4, 4))
    derivatives[:, 0, 0] = inertia
    derivatives[:, 1, 1] = at_rest
    derivatives[:, 2, 1] = -at_rest / (2.0 * top_speed_rad_s)
    derivatives[:, 2, 2] = at_top / (2.0 * top_speed_rad_s)
    derivatives[:, LAG, LAG] = 1.0
    return derivatives


def fitted_unknowns(parameters: Array, top_speed_rad_s: Array) -> Array:
    """(fans, 4) the inverse of physical_parameters. Damping that is not positive becomes a hundredth of the larger."""
    inertia, viscous, drag, lag_s = parameters.T
    damping = np.stack((viscous, viscous + 2.0 * drag * top_speed_rad_s))
    damping = np.maximum(damping, 0.01 * np.abs(damping).max(axis=0))
    return np.column_stack((np.log(inertia), *np.log(damping), lag_s))
