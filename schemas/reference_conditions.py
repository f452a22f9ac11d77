"""The supply voltage and the air for which a twin holds, and how commands and speeds of others are converted to them.

A drive's torque is proportional to its supply voltage, aerodynamic drag to the density of the air, and that to 1 / T:

    J w' + alpha w + d C_D w|w| = r command,    r = voltage / reference voltage,  d = reference T / T  (in K)

While d is constant, the speed v = d w obeys the equation of the reference conditions with the command r d command:

    J v' + alpha v + C_D v|v| = r d command

So a twin needs no other inputs than a command and gives no other output than a speed, whatever its kind: maker and
runtime convert the command before it and the speed after it. Air changes slowly; its temperature counts in steps.
"""

from __future__ import annotations

from typing import Annotated, TypeAlias

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

Array: TypeAlias = NDArray[np.float64]
Flags: TypeAlias = NDArray[np.bool_]

ZERO_C_IN_K = 273.15
TEMPERATURE_STEP_C = 1.0
"""a temperature that differs by no more from the one in use does not change it: noise would shake the prediction"""
HOLD_S = {"supply_voltage_v": 5.0, "temperature_c": 300.0}
"""how long a measured value counts for the samples after it that have none"""
NEVER_S = -1e18


@dataclass(frozen=True, config=ConfigDict(extra="ignore", allow_inf_nan=False))
class ReferenceConditions:
    """The conditions of a twin; None: the twin does not know what the quantity does, and does not need it."""

    supply_voltage_v: Annotated[float, Field(gt=0)] | None = None
    temperature_c: Annotated[float, Field(gt=-ZERO_C_IN_K)] | None = None

    @property
    def needed(self) -> tuple[str, ...]:
        """The columns that the twin needs."""
        values = {"supply_voltage_v": self.supply_voltage_v, "temperature_c": self.temperature_c}
        return tuple(name for name, value in values.items() if value is not None)

    @property
    def in_words(self) -> str:
        """The quantities and their reference values."""
        supply = "" if self.supply_voltage_v is None else f"supply voltage (reference {self.supply_voltage_v:.4g} V)"
        air = "" if self.temperature_c is None else f"temperature (reference {self.temperature_c:.3g} °C)"
        return " and ".join(filter(None, (supply, air)))

    def torque_ratio(self, supply_voltage_v: Array) -> Array:
        """r: the torque of a command relative to that at the reference voltage."""
        assert self.supply_voltage_v is not None
        return supply_voltage_v / self.supply_voltage_v

    def density_ratio(self, temperature_c: Array) -> Array:
        """d: the density of the air relative to that at the reference temperature."""
        assert self.temperature_c is not None
        return (self.temperature_c + ZERO_C_IN_K) / (temperature_c + ZERO_C_IN_K)


class HeldValue:
    """A measured column, the last known value of each fan held. All state is in arrays, (fans,)."""

    def __init__(self, fans: int, hold_s: float, step: float = 0.0) -> None:
        """hold_s: a value counts for so long. step: a value that differs by no more from the one in use is ignored."""
        self._hold_s, self._step = hold_s, step
        self.value = np.full(fans, np.nan)
        self.used = np.full(fans, np.nan)
        self.known_s = np.full(fans, NEVER_S)

    def columns(self) -> dict[str, Array]:
        """The arrays that hold the state; what is written into them is the state."""
        return {"value": self.value, "used": self.used, "known_s": self.known_s}

    def update(self, t_s: Array, values: Array) -> tuple[Array, Flags]:
        """The value in use and whether it is known, (n, fans) each. t_s: (n,). values: (n, fans), NaN: not known.

        Where it is not known, the value in use is the last one; NaN before the first.
        """
        has = np.isfinite(values)
        rows = np.maximum.accumulate(np.where(has, np.arange(len(t_s))[:, np.newaxis], -1))
        held = np.where(rows < 0, self.value, np.take_along_axis(values, np.maximum(rows, 0), axis=0))
        known_s = np.where(rows < 0, self.known_s, t_s[np.maximum(rows, 0)])
        self.value[...], self.known_s[...] = held[-1], known_s[-1]
        return self._in_steps(held), t_s[:, np.newaxis] - known_s <= self._hold_s

    def _in_steps(self, held: Array) -> Array:
        if not self._step:
            return held
        used = np.broadcast_to(self.used, held.shape)
        if self._moves(held, self.used).any():
            used, now = np.empty_like(held), self.used.copy()
            for row, values in enumerate(held):
                now = np.where(self._moves(values, now), values, now)
                used[row] = now
            self.used[...] = now
        return used

    def _moves(self, values: Array, now: Array) -> Flags:
        return np.isfinite(values) & ~(np.abs(values - now) <= self._step)


class ConditionRatios:
    """The ratios of torque and density over the samples of some fans, block by block."""

    def __init__(self, reference: ReferenceConditions, fans: int) -> None:
        self._reference = reference
        self._supply = HeldValue(fans, HOLD_S["supply_voltage_v"])
        self._air = HeldValue(fans, HOLD_S["temperature_c"], TEMPERATURE_STEP_C)

    def columns(self) -> dict[str, Array]:
        """The arrays that hold the state, (fans,) each."""
        held = {"supply": self._supply, "air": self._air}
        return {f"{name}_{part}": array for name, value in held.items() for part, array in value.columns().items()}

    def update(self, t_s: Array, supply_voltage_v: Array, temperature_c: Array) -> tuple[Array, Array, Flags]:
        """r, d, and whether all that is needed is known, (n, fans) each. r and d are 1 before a first value.

        t_s: (n,). supply_voltage_v, temperature_c: (n, fans), or empty.
        """
        reference, fans = self._reference, len(self._supply.value)
        shape = (len(t_s), fans)
        torque, density, known = np.ones(shape), np.ones(shape), np.ones(shape, dtype=np.bool_)
        for needed, values, held, ratio in (
            (reference.supply_voltage_v, supply_voltage_v, self._supply, reference.torque_ratio),
            (reference.temperature_c, temperature_c, self._air, reference.density_ratio),
        ):
            if needed is None:
                continue
            given = np.asarray(values, np.float64) if len(values) else np.full(shape, np.nan)
            in_use, is_known = held.update(t_s, given)
            known = known & is_known
            found = np.where(np.isfinite(in_use), ratio(in_use), 1.0)
            if held is self._supply:
                torque = found
            else:
                density = found
        return torque, density, known
