"""What surrounds simulated fans and changes with time: the supply of the tray and the air; and what is measured of it.

The supply wanders around its nominal voltage, as one that others load (a first-order process), and the temperature of
the air swings around its mean. Air that is warmer than 20 degrees Celsius is thinner, and drags less; a 4-pin fan
controls its speed, and air does not change that.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

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
    """share of it for which 4-pin fans make up: 1 where they control their speed, 0 where that follows the supply"""
    temperature_c: float = REFERENCE_C
    """mean of the air"""
    temperature_swing_c: float = 0.0
    """amplitude around it"""
    temperature_period_s: float = 600.0
    measured: tuple[Measured, ...] = ()


class SurroundingsNow:
    """The supply and the air of a tray, moment after moment."""

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
