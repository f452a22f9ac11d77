"""The neural ODE: w' = W_o tanh(W_i [w, tau] + b_i) + b_o, equation (28) of Peng and Chen. 20 units, 81 parameters.

All fans share the network; a fan's own physical parameters do not enter.
"""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from twin.integration import RightHandSide, free_run
from twin.network import TanhNetwork
from twin.runs import Array
from twin.state import ODE_LAYOUT, StateLayout

UNITS = 20


@dataclass(frozen=True, eq=False)
class NeuralOde:
    """A network that is the whole right-hand side. Shapes as in models.TwinModel."""

    network: TanhNetwork
    kind: Literal["neural-ode"] = "neural-ode"
    state_layout: StateLayout = ODE_LAYOUT

    def with_theta(self, theta: Array) -> "NeuralOde":
        """The same model with other weights."""
        return replace(self, network=self.network.with_theta(theta))

    def known_acceleration(self, speed_rad_s: Array, command: Array, parameters: Array) -> Array:
        """The part of w' that is not learned: none."""
        return np.zeros_like(speed_rad_s)

    def right_hand_side(self, parameters: Array) -> RightHandSide:
        """w' of a batch of fans with the physical parameters (batch, 3)."""
        return self.network

    def advance(self, state: Array, command: Array, step_s: Array, parameters: Array) -> tuple[Array, Array]:
        """Free run from state; see models.TwinModel."""
        speed_rad_s, final = free_run(self.network.acceleration, state[:, 0], command, step_s)
        return speed_rad_s, final[:, np.newaxis]
