"""How large a fault must be to matter so much: its size from the wanted effect, by the fan's own steady state.

In open loop the command stays and the speed gives way: the effect is the change of the steady speed, in sigma of its
residual. Under a speed loop the speed stays and the command gives way: the effect is the change of the steady command,
in sigma of the torque balance. Both at the level that the fan is at, or moves about. The plant's own equation:

    gain supply drive(duty) = alpha w + C_D w^2 + coulomb         in V
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fantwin.schemas.messages import Array
from fantwin.simulation.plant import FanParameters, drive


@dataclass(frozen=True)
class Kind:
    """One kind of fault. cause: what an alarm should call it. sizes: given where an effect in sigma means nothing."""

    name: str
    cause: str
    is_step: bool = True
    sizes: tuple[float, ...] = ()


KINDS = (
    Kind("inlet", "drag_up"),
    Kind("blade", "drag_down"),
    Kind("rotor", "external_torque"),
    Kind("wear", "friction_up", is_step=False),
    Kind("supply", "gain_down"),
    Kind("tacho-scaling", "sensor_scaling"),
    Kind("tacho-stuck", "sensor_stuck", sizes=(1.0,)),
    Kind("tacho-dropout", "sensor_dropout", sizes=(0.5, 0.7, 0.8, 0.9, 1.0)),
)
EFFECTS_SIGMA = (0.5, 1.0, 2.0, 3.0, 5.0)
SMALLEST_FACTOR = 0.02


def needed_v(speed_rad_s: Array, fans: FanParameters) -> Array:
    """Torque that holds a speed."""
    return (fans.alpha + fans.C_D * speed_rad_s) * speed_rad_s + fans.coulomb_v


def held_speed_rad_s(torque_v: Array, fans: FanParameters) -> Array:
    """Speed that a torque holds, if it turns the fan."""
    alpha, free_v = np.asarray(fans.alpha), torque_v - fans.coulomb_v
    return 2.0 * free_v / (alpha + np.sqrt(alpha**2 + 4.0 * fans.C_D * free_v))


def given_v(duty: Array, fans: FanParameters) -> Array:
    """Torque of a duty."""
    return fans.gain * fans.supply_v * drive(duty, fans)


def size(kind: str, speed_rad_s: Array, fans: FanParameters, change_rad_s: Array, change_of_command: Array) -> Array:
    """(fans,) factor on drag, supply or reading, or braking torque in V.

    speed_rad_s: the healthy fans' steady one. change_rad_s, change_of_command: how large the effect is to be, above
    zero; one of the two is zero, by fan: the speed where the command gives way, the command where the speed does.
    """
    way = -1.0 if kind == "blade" else 1.0  # a lighter fan runs faster, and needs less
    at = speed_rad_s - way * change_rad_s
    volts_per_command = fans.gain * fans.supply_v / (np.asarray(fans.duty_full) - np.asarray(fans.duty_dead))
    given = needed_v(speed_rad_s, fans) + way * change_of_command * volts_per_command
    if kind in ("inlet", "blade"):
        factor = (given - fans.coulomb_v - fans.alpha * at) / (fans.C_D * np.square(at))
        return np.maximum(factor, SMALLEST_FACTOR)
    if kind in ("rotor", "wear"):
        return given - needed_v(at, fans)
    if kind == "supply":
        return needed_v(at, fans) / given
    assert kind == "tacho-scaling", kind
    return at / held_speed_rad_s(given, fans)
