"""The hybrid: w' = (tau - alpha w - C_D w|w|) / J + network, equation (31) of Peng and Chen. 10 units.

Each fan keeps its own identified physics, which training does not move; all fans share one network for what the
physics miss (friction, dead zone, drive). 41 weights on [w, tau] or 31 on [w]; with the physics 44 or 34 parameters.
"""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from twin import physics
from twin.integration import RightHandSide, free_run
from twin.network import TanhNetwork
from twin.runs import Array
from twin.state import ODE_LAYOUT, StateLayout

UNITS = 10


@dataclass(frozen=True, eq=False)
class HybridRightHandSide:
    """w' of physics (batch, 3) plus a network; theta of linearise is the network's."""

    network: TanhNetwork
    parameters: Array

    def acceleration(self, speed_rad_s: Array, command: Array) -> Array:
        """(..., batch) in rad/s^2."""
        known = physics.acceleration(speed_rad_s, command, self.parameters)
        return known + self.network.acceleration(speed_rad_s, command)

    def linearise(self, speed_rad_s: Array, command: Array) -> tuple[Array, Array, Array]:
        """See integration.RightHandSide."""
        learned, by_speed, by_theta = self.network.linearise(speed_rad_s, command)
        value = learned + physics.acceleration(speed_rad_s, command, self.parameters)
        return value, by_speed + physics.acceleration_by_speed(speed_rad_s, self.parameters), by_theta


@dataclass(frozen=True, eq=False)
class Hybrid:
    """Fixed physics per fan and one shared network. Shapes as in models.TwinModel."""

    network: TanhNetwork
    kind: Literal["hybrid"] = "hybrid"
    state_layout: StateLayout = ODE_LAYOUT

    def with_theta(self, theta: Array) -> "Hybrid":
        """The same model with other weights."""
        return replace(self, network=self.network.with_theta(theta))

    def known_acceleration(self, speed_rad_s: Array, command: Array, parameters: Array) -> Array:
        """The part of w' that is not learned: the physics."""
        return physics.acceleration(speed_rad_s, command, parameters)

    def right_hand_side(self, parameters: Array) -> RightHandSide:
        """w' of a batch of fans with the physical parameters (batch, 3)."""
        return HybridRightHandSide(self.network, parameters)

    def advance(self, state: Array, command: Array, step_s: Array, parameters: Array) -> tuple[Array, Array]:
        """Free run from state; see models.TwinModel."""
        rhs = HybridRightHandSide(self.network, parameters)
        speed_rad_s, final = free_run(rhs.acceleration, state[:, 0], command, step_s)
        return speed_rad_s, final[:, np.newaxis]
