"""The hybrid: w' = (tau - alpha w - C_D w|w|) / J + network, equation (31) of Peng and Chen. 10 units.

Each fan has its own physics; all fans share one network for what the physics miss (friction, dead zone, drive). 41
weights on [w, tau] or 31 on [w]; with J, alpha and C_D 44 or 34 parameters.
"""

from dataclasses import dataclass, replace
from typing import ClassVar

from schemas.twin_card import NetworkCard, StateLayout
from twin.models.network import TanhNetwork
from twin.models.ode_graph import ode_graph
from twin.models.onnx_nodes import Nodes
from twin.models.physics import LAG, PARAMETER_NAMES
from twin.models.right_hand_side import ODE_LAYOUT, FanEquation, advance
from twin.runs import Array

UNITS = 10


@dataclass(frozen=True, eq=False)
class Hybrid:
    """Physics per fan and one shared network. Shapes as in model.TwinModel."""

    network: TanhNetwork
    state_layout: StateLayout = ODE_LAYOUT

    kind: ClassVar[str] = "hybrid"
    has_physics: ClassVar[bool] = True
    fixed_rate: ClassVar[bool] = False
    used_parameters: ClassVar[tuple[str, ...]] = PARAMETER_NAMES

    @property
    def theta(self) -> Array:
        """(P,) the weights of the network."""
        return self.network.theta

    @property
    def network_card(self) -> NetworkCard:
        """The size of the network."""
        return self.network.card

    def with_theta(self, theta: Array) -> "Hybrid":
        """The same model with other weights."""
        return replace(self, network=self.network.with_theta(theta))

    def equation(self, parameters: Array) -> FanEquation:
        """w' of a batch of fans with the physical parameters (batch, 4)."""
        return FanEquation(parameters, self.network)

    def advance(self, state: Array, command: Array, step_s: Array, parameters: Array) -> tuple[Array, Array]:
        """Free run from state; see model.TwinModel."""
        return advance(self.equation(parameters), state, command, step_s, parameters[:, LAG])

    def graph(self) -> Nodes:
        """See model.Model."""
        return ode_graph(self.network, has_physics=self.has_physics)
