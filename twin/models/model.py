"""What the four models have in common, and their table."""

from typing import Literal, Protocol, get_args

from twin.models.hybrid import Hybrid
from twin.models.narx import Narx
from twin.models.neural_ode import NeuralOde
from twin.models.physical import PhysicalModel
from twin.models.state import StateLayout
from twin.runs import Array

Kind = Literal["physical", "narx", "neural-ode", "hybrid"]
KINDS: tuple[Kind, ...] = get_args(Kind)

Model = PhysicalModel | Narx | NeuralOde | Hybrid
NetworkOde = NeuralOde | Hybrid
OdeModel = PhysicalModel | NeuralOde | Hybrid


class TwinModel(Protocol):
    """State and commands in, speeds and state out."""

    @property
    def state_layout(self) -> StateLayout:
        """What the state holds."""
        ...

    def advance(self, state: Array, command: Array, step_s: Array, parameters: Array) -> tuple[Array, Array]:
        """Free run over a block of samples.

        state: (fans, n_state). command: (n, fans), held. step_s: (n,) time from sample k to k + 1. parameters:
        (fans, 4). Returns speed_rad_s (n, fans), at each sample before its command acts, and the state after the last
        step. Two blocks with the state carried over give what one block gives.
        """
        ...
