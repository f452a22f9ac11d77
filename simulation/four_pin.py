"""Simulated 4-pin fans: PWM duty to speed, as their own controllers make it.

Each fan follows a wanted speed with a first-order lag, slower downwards than upwards (it coasts). The wanted speed is a
concave curve of the duty above `duty_min`, a plateau below it, and nothing below `duty_stop`; after standstill the fan
is driven harder for `kick_s`. The supply of a tray sags with the load of all its fans; the air of the room changes
slowly; the speed wanders a little. `supply_factor` is a further change of the supply, which can be measured. A fan that
holds its speed compensates for it, as long as the supply suffices.

What Intel's "4-Wire Pulse Width Modulation (PWM) Controlled Fans Specification", revision 1.3 (2005), says is marked
with its section below; it leaves dynamics to the vendor. All other defaults are those of a typical 120 mm fan.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fantwin.simulation.plant import Array, varied

RPM = 2.0 * np.pi / 60.0
STANDSTILL_RAD_S = 30.0 * RPM
"""below it a fan without drive stops"""
STOPPED_BY_BLOCK_RAD_S = 60.0 * RPM
BLOCK_S = 0.03
"""time constant of a blocked rotor"""
KICK_BELOW = 0.05
"""share of the full speed below which a fan that is switched on gets a start pulse"""


@dataclass(frozen=True)
class FourPinParameters:
    """One fan (numbers) or fans (each field (fans,))."""

    speed_max_rad_s: float | Array = 2200.0 * RPM
    """speed at full duty (3.1: set by the vendor)"""
    speed_min_rad_s: float | Array = 300.0 * RPM
    """speed of the plateau (3.2: at most 30 % of the full speed)"""
    duty_min: float | Array = 0.2
    """duty at which the plateau ends (3.2: set by the vendor)"""
    duty_stop: float | Array = 0.08
    """duty below which the fan stops (3.4: "type B" stops at 0 only, "type C" where its current no longer turns it)"""
    bend: float | Array = 0.9
    """exponent of the curve above the plateau; below 1 it is concave (3.3: monotonic, within 10 % of the duty)"""
    up_s: float | Array = 0.8
    """time constant of a rise"""
    down_s: float | Array = 1.3
    """time constant of a fall"""
    kick_s: float | Array = 0.6
    """duration of the start pulse (3.2: at most 2 s)"""
    kick_speed_rad_s: float | Array = 1100.0 * RPM
    """wanted speed during the start pulse; the speed then reaches about 26 % of the full speed (3.2: at most 30 %)"""
    sag: float | Array = 0.02
    """share of the speed that is lost when all fans of the tray turn at full speed, and their supply gives way"""
    wander: float | Array = 0.003
    """standard deviation of the wandering of the speed, relative"""
    wander_s: float | Array = 3.0
    """correlation time of that"""
    air: float | Array = 0.01
    """amplitude of the slow change of the speed with the air of the room, relative"""
    air_period_s: float | Array = 3600.0
    """period of that"""
    reserve: float | Array = 0.1
    """share by which the fastest possible speed exceeds the full speed, at the nominal supply"""


VARYING_PARAMETERS = ("speed_max_rad_s", "speed_min_rad_s", "bend", "up_s", "down_s")


@dataclass(frozen=True)
class FourPinDamage:
    """Damage of the fans, (fans,) each. The defaults are those of a healthy fan."""

    speed_factor: float | Array = 1.0
    """on the wanted speed"""
    up_factor: float | Array = 1.0
    """on the time constant of a rise"""
    down_factor: float | Array = 1.0
    """on the time constant of a fall"""
    is_blocked: bool | NDArray[np.bool_] = False
    """the rotor cannot turn"""
    is_unpowered: bool | NDArray[np.bool_] = False
    """no supply"""


NO_DAMAGE = FourPinDamage()


def four_pin_tray(fans: int, seed: int, fan_variation: float = 0.03) -> FourPinParameters:
    """Parameters of fans that differ, as of `plant.varied`."""
    return varied(FourPinParameters(), VARYING_PARAMETERS, fans, seed, fan_variation)


def wanted_speed_rad_s(duty: Array, parameters: FourPinParameters) -> Array:
    """(fans,) settled speed of a running fan at a duty, before sag, air and wandering."""
    p = parameters
    rise = np.clip((duty - p.duty_min) / (1.0 - np.asarray(p.duty_min)), 0.0, 1.0) ** p.bend
    wanted = p.speed_min_rad_s + (np.asarray(p.speed_max_rad_s) - p.speed_min_rad_s) * rise
    return np.where(duty < p.duty_stop, 0.0, wanted)


class FourPinFans:
    """Fans that stand at first. Within a step the wanted speed is constant, and the lag is exact."""

    longest_step_s = 0.1

    def __init__(
        self, parameters: FourPinParameters, rng: np.random.Generator, fans_per_supply: int, copies: int = 1
    ) -> None:
        """Prepare.

        parameters: each field (fans,). rng: of the wandering and of the phase of the air. fans_per_supply: so many
        neighbours share a supply and a room. copies: the fans are so many times the same ones, in the same air.
        """
        self.parameters = parameters
        self._rng = rng
        fans = len(np.asarray(parameters.speed_max_rad_s))
        self._per_supply = fans_per_supply
        rooms = fans // fans_per_supply // copies
        self._phase = np.tile(np.repeat(rng.uniform(0.0, 2.0 * np.pi, size=rooms), fans_per_supply), copies)
        self._wander = np.zeros(fans)
        self._was_on = np.zeros(fans, np.bool_)
        self._kick_left_s = np.zeros(fans)
        self._t_s = 0.0
        self.damage = NO_DAMAGE
        self.supply_factor = 1.0
        """present supply voltage over the nominal one"""
        self.supply_held = 1.0
        """the speed is in proportion to `supply_factor ** (1 - supply_held)`: 1 holds the speed against the supply"""
        self.speed_rad_s = np.zeros(fans)

    def advance(self, duty: Array, duration_s: float) -> None:
        """Turn for `duration_s` <= `longest_step_s` with duty (fans,) and damage held."""
        if duration_s <= 0.0:
            return
        p, damage = self.parameters, self.damage
        is_on = (duty >= p.duty_stop) & ~np.asarray(damage.is_unpowered)
        starts = is_on & ~self._was_on & (self.speed_rad_s < KICK_BELOW * np.asarray(p.speed_max_rad_s))
        left_s = np.where(is_on, np.where(starts, p.kick_s, self._kick_left_s), 0.0)
        wanted = np.where(left_s > 1e-9, p.kick_speed_rad_s, wanted_speed_rad_s(duty, p))
        wanted = np.where(is_on, wanted * self._surroundings(duration_s) * damage.speed_factor, 0.0)
        wanted = np.minimum(wanted * self.supply_factor ** (1.0 - self.supply_held), self._fastest_rad_s())
        rises = wanted > self.speed_rad_s
        lag_s = np.where(rises, p.up_s * np.asarray(damage.up_factor), p.down_s * np.asarray(damage.down_factor))
        speed = wanted + (self.speed_rad_s - wanted) * np.exp(-duration_s / lag_s)
        speed = np.where((wanted == 0.0) & (speed < STANDSTILL_RAD_S), 0.0, speed)
        self.speed_rad_s = self._blocked(speed, duration_s)
        self._kick_left_s = np.maximum(left_s - duration_s, 0.0)
        self._was_on = is_on
        self._t_s += duration_s

    def _surroundings(self, duration_s: float) -> Array:
        """(fans,) factor of supply, air and wandering on the wanted speed."""
        p = self.parameters
        load = np.square(self.speed_rad_s / p.speed_max_rad_s).reshape(-1, self._per_supply).sum(axis=1)
        kept = np.exp(-duration_s / np.asarray(p.wander_s))
        drawn = self._rng.normal(size=len(self._wander))
        self._wander = kept * self._wander + p.wander * np.sqrt(1.0 - kept * kept) * drawn
        air = p.air * np.sin(2.0 * np.pi * self._t_s / np.asarray(p.air_period_s) + self._phase)
        return (1.0 - p.sag / self._per_supply * np.repeat(load, self._per_supply)) * (1.0 + air) * (1.0 + self._wander)

    def _fastest_rad_s(self) -> Array:
        """(fans,) the fastest speed that the supply allows, rad/s; proportional to its voltage."""
        p = self.parameters
        return p.speed_max_rad_s * (1.0 + np.asarray(p.reserve)) * self.supply_factor

    def _blocked(self, speed_rad_s: Array, duration_s: float) -> Array:
        is_blocked = np.asarray(self.damage.is_blocked)
        if not is_blocked.any():
            return speed_rad_s
        braked = self.speed_rad_s * np.exp(-duration_s / BLOCK_S)
        return np.where(is_blocked, np.where(braked < STOPPED_BY_BLOCK_RAD_S, 0.0, braked), speed_rad_s)
