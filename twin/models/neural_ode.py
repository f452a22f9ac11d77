"""The neural ODE: w' = W_o tanh(W_i [w, tau] + b_i) + b_o, equation (28) of Peng and Chen. 20 units, 81 parameters.

All fans share the network; of a fan's own parameters only the lag of its command enters.
"""

from dataclasses import dataclass, replace
from typing import ClassVar

from schemas.twin_card import NetworkCard, StateLayout
from twin.models.network import TanhNetwork
from twin.models.ode_graph import ode_graph
from twin.models.onnx_nodes import Nodes
from twin.models.physics import LAG
from twin.models.right_hand_side import ODE_LAYOUT, FanEquation, advance
from twin.runs import Array

UNITS = 20


@dataclass(frozen=True, eq=False)
class NeuralOde:
    """A network that is the whole right-hand side. Shapes as in model.TwinModel."""

    network: TanhNetwork
    state_layout: StateLayout = ODE_LAYOUT

    kind: ClassVar[str] = "neural-ode"
    has_physics: ClassVar[bool] = False
    fixed_rate: ClassVar[bool] = False
    used_parameters: ClassVar[tuple[str, ...]] = ("lag_s",)

    @property
    def theta(self) -> Array:
        """(P,) the weights of the network."""
        return self.network.theta

    @property
    def network_card(self) -> NetworkCard:
        """The size of the network."""
        return self.network.card

    def with_theta(self, theta: Array) -> "NeuralOde":
        """The same model with other weights."""
        return replace(self, network=self.network.with_theta(theta))

    def equation(self, parameters: Array) -> FanEquation:
        """w' of a batch of fans; their physical parameters (batch, 4) do not enter."""
        return FanEquation(None, self.network)

    def advance(self, state: Array, command: Array, step_s: Array, parameters: Array) -> tuple[Array, Array]:
        """Free run from state; see model.TwinModel."""
        return advance(self.equation(parameters), state, command, step_s, parameters[:, LAG])

    def graph(self) -> Nodes:
        """See model.Model."""
        return ode_graph(self.network, has_physics=self.has_physics)
