"""The neural ODE: w' = W_o tanh(W_i [w, tau] + b_i) + b_o, equation (28) of Peng and Chen. 20 units, 81 parameters.

All fans share the network; of a fan's own parameters only the lag of its command enters.
"""

from dataclasses import dataclass, replace
from typing import Literal

from twin.models.network import TanhNetwork
from twin.models.physics import LAG
from twin.models.right_hand_side import FanEquation, advance
from twin.models.state import ODE_LAYOUT, StateLayout
from twin.runs import Array

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

    def equation(self, parameters: Array) -> FanEquation:
        """w' of a batch of fans; their physical parameters (batch, 4) do not enter."""
        return FanEquation(None, self.network)

    def advance(self, state: Array, command: Array, step_s: Array, parameters: Array) -> tuple[Array, Array]:
        """Free run from state; see models.TwinModel."""
        return advance(self.equation(parameters), state, command, step_s, parameters[:, LAG])
