"""The kinds of fans that a simulated tray can have, behind one interface."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal, Protocol

import numpy as np

from simulation.faults import Fault, disturbance, four_pin_damage
from simulation.four_pin import FourPinFans, FourPinParameters, four_pin_tray
from simulation.plant import HEALTHY, Array, FanParameters, advance, at_rest, tray_of_fans

FanKind = Literal["dc", "4-pin"]


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


def simulated_fans(kind: FanKind, fans: int, fans_seed: int, fan_variation: float, seed: int) -> Fans:
    """A tray of fans. seed: of what changes from run to run.

    Raises:
        SimulationError: fan_variation is out of range.
    """
    if kind == "dc":
        return _DcFans(tray_of_fans(fans, fans_seed, fan_variation))
    return _FourPinTray(four_pin_tray(fans, fans_seed, fan_variation), np.random.default_rng(seed), fans)


class _DcFans:
    """Fans by the equation of motion of `simulation.plant`."""

    longest_step_s = math.inf

    def __init__(self, parameters: FanParameters) -> None:
        self.parameters = parameters
        self._state = at_rest(len(np.asarray(parameters.J)))
        self._disturbance = HEALTHY

    @property
    def speed_rad_s(self) -> Array:
        return self._state.speed_rad_s

    def advance(self, duty: Array, duration_s: float) -> None:
        self._state = advance(self._state, duty, duration_s, self.parameters, self._disturbance)

    def set_faults(self, faults: Sequence[Fault], t_s: float) -> None:
        self._disturbance = disturbance(faults, len(self.speed_rad_s), t_s)


class _FourPinTray(FourPinFans):
    def set_faults(self, faults: Sequence[Fault], t_s: float) -> None:
        self.damage = four_pin_damage(faults, len(self.speed_rad_s), t_s)
