"""The physical fan: J w' + alpha w + C_D w|w| = tau, and the electrical lag of tau (twin.models.lag).

w is the rotor speed in rad/s and tau the applied torque command. The command enters as it was recorded, so J, alpha
and C_D are per unit of command. Drag is written w|w|, equal to the published w^2 for a fan that turns forwards, so
that it opposes the motion of one driven backwards. Equations (10) to (12) and (31) of Peng and Chen; they neglect the
lag, which is lag_s = 0. `command` here is the effective command, that is after the lag.
"""

import numpy as np

from fantwin.twin.runs import Array

PARAMETER_NAMES = ("J", "alpha", "C_D", "lag_s")
LAG = PARAMETER_NAMES.index("lag_s")


def acceleration(speed_rad_s: Array, command: Array, parameters: Array) -> Array:
    """(..., fans) rotor acceleration in rad/s^2. parameters: (fans, 4), in the order of PARAMETER_NAMES."""
    inertia, viscous, drag = parameters.T[:LAG]
    return (command - (viscous + drag * np.abs(speed_rad_s)) * speed_rad_s) / inertia


def acceleration_by_speed(speed_rad_s: Array, parameters: Array) -> Array:
    """(..., fans) derivative of the acceleration by the speed, in 1/s."""
    inertia, viscous, drag = parameters.T[:LAG]
    return -(viscous + 2.0 * drag * np.abs(speed_rad_s)) / inertia


def acceleration_by_parameters(speed_rad_s: Array, command: Array, parameters: Array, out: Array) -> None:
    """Write the derivatives of the acceleration by J, alpha and C_D into `out` (..., fans, 3)."""
    inertia = parameters.T[0]
    out[..., 0] = -acceleration(speed_rad_s, command, parameters) / inertia
    out[..., 1] = -speed_rad_s / inertia
    out[..., 2] = -speed_rad_s * np.abs(speed_rad_s) / inertia


def time_constant_s(speed_rad_s: Array, parameters: Array) -> Array:
    """(fans,) time in which a small deviation from speed_rad_s decays by e: -1 / acceleration_by_speed.

    Infinite where it does not decay: at rest, without viscous drag.
    """
    rate = -acceleration_by_speed(speed_rad_s, parameters)
    return np.divide(1.0, rate, out=np.full_like(rate, np.inf), where=rate != 0.0)
