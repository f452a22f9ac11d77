"""Simulated fans: the equation of motion with friction, electrical lag, dead zone and saturation; their supply and air.

    J w' + alpha w + C_D w|w| = gain i - friction(w)       torques in V-equivalents
    lag i' + i = supply * drive(duty)                      current follows the bridge
    drive(duty) = clip((duty - dead) / (full - dead), 0, 1)
    friction(w) = sign(w) (coulomb + (breakaway - coulomb) exp(-(w / stribeck)^2)), up to breakaway at standstill

J, alpha and C_D are per volt, as identified on the real fan of Peng and Chen (equation (12) there); the Stribeck
curve is that of Armstrong-Helouvry, Dupont and Canudas de Wit (Automatica 30, 1994).

Time stepping: the current is exact for a held command, the smooth part of the motion is a midpoint step (order two),
and friction is an impulse that can stop the rotor but never reverse it (Moreau), so that a rotor below breakaway
has exactly zero speed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, ClassVar, Literal, Protocol, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from fantwin.simulation.errors import SimulationError

Array: TypeAlias = NDArray[np.float64]
Measured = Literal["supply_voltage_v", "current_a", "temperature_c"]

ZERO_C_IN_K = 273.15
REFERENCE_C = 20.0
"""the drag of the plant's parameters is that of air of this temperature"""
BACK_EMF_SHARE = 0.7
"""of the viscous drag alpha: the voltage that a turning motor takes from its own supply"""
RESISTANCE_OHM = 8.0
VOLTAGE_NOISE_V, CURRENT_NOISE_A, TEMPERATURE_NOISE_C = 0.02, 0.01, 0.1


@dataclass(frozen=True)
class Surroundings:
    """Settings. measured: the columns that the tray sends beside command and speed."""

    supply_wander: float = 0.0
    """standard deviation of the supply voltage, relative"""
    supply_wander_s: float = 20.0
    """correlation time of that"""
    supply_held: float = 1.0
    """of 4-pin fans: 1 if they hold their speed against the supply, 0 if it is proportional to the supply"""
    temperature_c: float = REFERENCE_C
    """mean of the air"""
    temperature_swing_c: float = 0.0
    """amplitude around it"""
    temperature_period_s: float = 600.0
    measured: tuple[Measured, ...] = ()


class SurroundingsNow:
    """The supply and the air of a tray, moment after moment, and what is measured of them.

    The supply wanders around its nominal voltage, as one that others load (a first-order process), and the temperature
    of the air swings around its mean. Air that is warmer than 20 degrees Celsius is thinner, and drags less. The
    temperature does not change the speed of a 4-pin fan, which controls it.
    """

    def __init__(self, settings: Surroundings, rng: np.random.Generator) -> None:
        self._settings = settings
        self._rng = rng
        self._wander = settings.supply_wander * rng.normal()
        self._t_s = 0.0

    def advance(self, t_s: float) -> None:
        """Go on to t_s, seconds since the start."""
        kept = math.exp(-(t_s - self._t_s) / self._settings.supply_wander_s)
        drawn = self._rng.normal() * math.sqrt(1.0 - kept * kept)
        self._wander = kept * self._wander + self._settings.supply_wander * drawn
        self._t_s = t_s

    @property
    def supply_factor(self) -> float:
        """Of the supply voltage now."""
        return max(0.0, 1.0 + self._wander)

    @property
    def temperature_c(self) -> float:
        """Of the air now."""
        phase = 2.0 * math.pi * self._t_s / self._settings.temperature_period_s
        return self._settings.temperature_c + self._settings.temperature_swing_c * math.sin(phase)

    @property
    def drag_factor(self) -> float:
        """Of the aerodynamic drag now: the density of the air relative to that at 20 degrees Celsius."""
        return (REFERENCE_C + ZERO_C_IN_K) / (self.temperature_c + ZERO_C_IN_K)

    def measure(self, supply_v: Array, current_a: Array) -> dict[str, Array]:
        """The columns that are measured, (fans,) each, by name. supply_v, current_a: the true ones, (fans,)."""
        fans = len(supply_v)
        true: dict[Measured, tuple[Array, float]] = {
            "supply_voltage_v": (supply_v, VOLTAGE_NOISE_V),
            "current_a": (current_a, CURRENT_NOISE_A),
            "temperature_c": (np.full(fans, self.temperature_c), TEMPERATURE_NOISE_C),
        }
        return {name: true[name][0] + true[name][1] * self._rng.normal(size=fans) for name in self._settings.measured}


MAX_SUBSTEP_S = 1e-3


@dataclass(frozen=True)
class FanParameters:
    """One fan (numbers) or a tray of fans (each field (fans,)). V is torque in volt-equivalents."""

    J: float | Array = 0.0148
    """inertia, V s^2/rad"""
    alpha: float | Array = 0.0074
    """viscous drag, V s/rad"""
    C_D: float | Array = 5.4772e-6
    """aerodynamic drag, V s^2/rad^2"""
    supply_v: float | Array = 12.0
    """drive voltage at full duty, V"""
    gain: float | Array = 1.0
    """torque per volt, relative to the fan for which J, alpha and C_D hold"""
    lag_s: float | Array = 0.012
    """electrical time constant of the current, s"""
    coulomb_v: float | Array = 0.08
    """sliding friction, V"""
    breakaway_v: float | Array = 0.25
    """largest friction at standstill, V; not below coulomb_v"""
    stribeck_rad_s: float | Array = 6.0
    """speed at which friction has fallen by 63 % from breakaway to sliding, rad/s"""
    duty_dead: float | Array = 0.02
    """duty up to which the bridge gives no voltage"""
    duty_full: float | Array = 0.99
    """duty from which the bridge is fully on"""


VARYING_PARAMETERS = ("J", "alpha", "C_D", "gain", "lag_s", "coulomb_v", "breakaway_v", "stribeck_rad_s")


class _Dataclass(Protocol):
    __dataclass_fields__: ClassVar[dict[str, Any]]


Parameters = TypeVar("Parameters", bound=_Dataclass)


def varied(base: Parameters, varying: Sequence[str], fans: int, seed: int, fan_variation: float) -> Parameters:
    """Parameters of fans, each field (fans,). Fans differ by a normal variation, cut at three standard deviations.

    varying: names of the parameters that vary. fan_variation: relative standard deviation of each. The same seed gives
    the same fans.

    Raises:
        SimulationError: fan_variation is negative or so large that a parameter could become negative.
    """
    if not 0.0 <= fan_variation < 0.3:
        raise SimulationError(f"fan_variation = {fan_variation:g}: give a relative standard deviation from 0 to 0.3")
    rng = np.random.default_rng(seed)
    own = {}
    for field in fields(base):
        own[field.name] = np.full(fans, getattr(base, field.name), dtype=np.float64)
        if field.name in varying:
            own[field.name] *= 1.0 + fan_variation * np.clip(rng.normal(size=fans), -3.0, 3.0)
    return replace(base, **own)


def tray_of_fans(fans: int, seed: int, fan_variation: float = 0.03, base: FanParameters | None = None) -> FanParameters:
    """Parameters of a tray of fans that differ, as of `varied`."""
    tray = varied(base or FanParameters(), VARYING_PARAMETERS, fans, seed, fan_variation)
    return replace(tray, breakaway_v=np.maximum(tray.breakaway_v, tray.coulomb_v))


def drive(duty: Array, parameters: FanParameters) -> Array:
    """(fans,) share of the supply voltage that reaches the fan: dead zone, slope, saturation."""
    return np.clip((duty - parameters.duty_dead) / (parameters.duty_full - parameters.duty_dead), 0.0, 1.0)


@dataclass(frozen=True)
class Disturbance:
    """External influences and damage; each field (fans,). The defaults are those of a healthy fan."""

    drag_factor: float | Array = 1.0
    """multiplies C_D"""
    brake_v: float | Array = 0.0
    """braking torque that adds to friction, V"""
    supply_factor: float | Array = 1.0
    """multiplies the supply voltage"""


HEALTHY = Disturbance()


@dataclass(frozen=True)
class PlantState:
    """Speed (fans,) in rad/s and current (fans,), expressed as the voltage that would cause it, V."""

    speed_rad_s: Array
    current_v: Array


def at_rest(fans: int) -> PlantState:
    """All fans at zero speed, without current."""
    return PlantState(np.zeros(fans), np.zeros(fans))


def advance(
    state: PlantState,
    duty: Array,
    duration_s: float,
    parameters: FanParameters,
    disturbance: Disturbance = HEALTHY,
    longest_substep_s: float = MAX_SUBSTEP_S,
) -> PlantState:
    """The state `duration_s` later with duty (fans,) and disturbance held."""
    if duration_s <= 0.0:
        return state
    substeps = int(np.ceil(duration_s / longest_substep_s))
    step_s = duration_s / substeps
    target_v = parameters.supply_v * disturbance.supply_factor * drive(duty, parameters)
    decay = np.exp(-step_s / np.asarray(parameters.lag_s))
    # The impulse on the rotor comes from the mean of the current over a substep.
    mean_share = (1.0 - decay) * parameters.lag_s / step_s
    drag = parameters.C_D * disturbance.drag_factor
    coulomb = parameters.coulomb_v + disturbance.brake_v
    rise = parameters.breakaway_v - parameters.coulomb_v
    inverse_stribeck = 1.0 / np.asarray(parameters.stribeck_rad_s)
    per_inertia_s = step_s / np.asarray(parameters.J)
    half_per_inertia_s = 0.5 * per_inertia_s
    speed, current = state.speed_rad_s, state.current_v
    for _ in range(substeps):
        excess_v = current - target_v
        torque = parameters.gain * (target_v + excess_v * mean_share)
        current = target_v + excess_v * decay
        half = speed + half_per_inertia_s * (torque - (parameters.alpha + drag * np.abs(speed)) * speed)
        free = speed + per_inertia_s * (torque - (parameters.alpha + drag * np.abs(half)) * half)
        impulse = per_inertia_s * (coulomb + rise * np.exp(-np.square(speed * inverse_stribeck)))
        speed = np.sign(free) * np.maximum(np.abs(free) - impulse, 0.0)
    return PlantState(speed, current)


@dataclass(frozen=True)
class DeviceClock:
    """The device clock: 32 bits of microseconds, fast by `drift_ppm` (negative: slow), at `start_us` at time 0."""

    drift_ppm: float = 0.0
    start_us: int = 0

    def at(self, t_s: float) -> int:
        """Reading of the clock at true time t_s; wraps at 2^32."""
        return (self.start_us + round(t_s * (1e6 + self.drift_ppm))) % 2**32
