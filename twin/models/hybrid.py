"""The hybrid: w' = (tau - alpha w - C_D w|w|) / J + network, equation (31) of Peng and Chen. 10 units.

Each fan has its own physics; all fans share one network for what the physics miss (friction, dead zone, drive). 41
weights on [w, tau] or 31 on [w]; with J, alpha and C_D 44 or 34 parameters.
"""

from dataclasses import dataclass, replace
from typing import Literal

from twin.models.network import TanhNetwork
from twin.models.physics import LAG
from twin.models.right_hand_side import FanEquation, advance
from twin.models.state import ODE_LAYOUT, StateLayout
from twin.runs import Array

UNITS = 10


@dataclass(frozen=True, eq=False)
class Hybrid:
    """Physics per fan and one shared network. Shapes as in models.TwinModel."""

    network: TanhNetwork
    kind: Literal["hybrid"] = "hybrid"
    state_layout: StateLayout = ODE_LAYOUT

    def with_theta(self, theta: Array) -> "Hybrid":
        """The same model with other weights."""
        return replace(self, network=self.network.with_theta(theta))

    def equation(self, parameters: Array) -> FanEquation:
        """w' of a batch of fans with the physical parameters (batch, 4)."""
        return FanEquation(parameters, self.network)

    def advance(self, state: Array, command: Array, step_s: Array, parameters: Array) -> tuple[Array, Array]:
        """Free run from state; see models.TwinModel."""
        return advance(self.equation(parameters), state, command, step_s, parameters[:, LAG])
