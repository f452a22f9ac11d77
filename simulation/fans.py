"""The kinds of fans that a simulated tray can have, behind one interface."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Literal, Protocol

import numpy as np

from fantwin.simulation.faults import Fault, disturbance, four_pin_damage
from fantwin.simulation.four_pin import FourPinFans, FourPinParameters
from fantwin.simulation.plant import (
    BACK_EMF_SHARE,
    HEALTHY,
    RESISTANCE_OHM,
    Array,
    Disturbance,
    FanParameters,
    advance,
    at_rest,
)

FanKind = Literal["dc", "4-pin"]
FOUR_PIN_SUPPLY_V = 12.0


class Fans(Protocol):
    """The fans of a tray, at rest at first."""

    longest_step_s: float
    """longest step that `advance` may be given"""

    @property
    def parameters(self) -> FanParameters | FourPinParameters:
        """Each field (fans,)."""
        ...

    @property
    def speed_rad_s(self) -> Array:
        """(fans,) speeds now."""
        ...

    def advance(self, duty: Array, duration_s: float) -> None:
        """Turn for a while with duty (fans,) and faults held."""
        ...

    def set_faults(self, faults: Sequence[Fault], t_s: float) -> None:
        """The faults act from now on as they do at t_s."""
        ...

    def surround(self, supply_factor: float, drag_factor: float) -> tuple[Array, Array]:
        """The supply voltage and the drag are changed by these factors from now on, beside faults.

        Returns the voltage and the current of each fan, V and A (fans,); NaN where it is not simulated.
        """
        ...


class DcFans:
    """Fans by the equation of motion of `simulation.plant`."""

    longest_step_s = math.inf

    def __init__(self, parameters: FanParameters) -> None:
        self.parameters = parameters
        self._state = at_rest(len(np.asarray(parameters.J)))
        self._damage, self._around = HEALTHY, (1.0, 1.0)

    @property
    def speed_rad_s(self) -> Array:
        """See Fans."""
        return self._state.speed_rad_s

    @property
    def _disturbance(self) -> Disturbance:
        supply, drag = (self._damage.supply_factor, self._damage.drag_factor)
        return replace(self._damage, supply_factor=supply * self._around[0], drag_factor=drag * self._around[1])

    def advance(self, duty: Array, duration_s: float) -> None:
        """See Fans."""
        self._state = advance(self._state, duty, duration_s, self.parameters, self._disturbance)

    def set_faults(self, faults: Sequence[Fault], t_s: float) -> None:
        """See Fans."""
        self._damage = disturbance(faults, len(self.speed_rad_s), t_s)

    def surround(self, supply_factor: float, drag_factor: float) -> tuple[Array, Array]:
        """See Fans. The current is by what drives it less what the turning motor induces."""
        self._around = supply_factor, drag_factor
        supply_v = np.broadcast_to(self.parameters.supply_v * self._disturbance.supply_factor, self.speed_rad_s.shape)
        back_emf_v = BACK_EMF_SHARE * self.parameters.alpha * self.speed_rad_s
        return supply_v, (self._state.current_v - back_emf_v) / RESISTANCE_OHM


class FourPinTray(FourPinFans):
    """4-pin fans on one supply."""

    def set_faults(self, faults: Sequence[Fault], t_s: float) -> None:
        """See Fans."""
        self.damage = four_pin_damage(faults, len(self.speed_rad_s), t_s)

    def surround(self, supply_factor: float, drag_factor: float) -> tuple[Array, Array]:
        """See Fans. A fan without power has no voltage; one that controls its speed does not feel the air."""
        self.supply_factor = supply_factor
        supply_v = np.full(len(self.speed_rad_s), FOUR_PIN_SUPPLY_V * supply_factor)
        return np.where(self.damage.is_unpowered, 0.0, supply_v), np.full(len(supply_v), np.nan)
