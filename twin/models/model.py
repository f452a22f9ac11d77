"""What a model of a fan must offer: the protocols that evaluation, fitting and export rely on.

A kind of model is one class in a file of its own in this package. twin.kinds lists the kinds.
"""

from typing import ClassVar, Protocol, runtime_checkable

from fantwin.schemas.steady_curve import SteadyCurve
from fantwin.schemas.twin_card import NetworkCard, StateLayout
from fantwin.twin.models.onnx_nodes import Nodes
from fantwin.twin.runs import Array


class TwinModel(Protocol):
    """State and commands in, speeds and state out. Both a model in memory and a file in onnxruntime implement it."""

    @property
    def state_layout(self) -> StateLayout:
        """What the state holds."""
        ...

    def advance(self, state: Array, command: Array, step_s: Array, parameters: Array) -> tuple[Array, Array]:
        """Free run over a block of samples.

        state: (fans, n_state). command: (n, fans), held. step_s: (n,) time from sample k to k + 1. parameters:
        (fans, 4), behind a drive (fans, 7). Returns speed_rad_s (n, fans), at each sample before its command acts, and
        the state after the last step. Two blocks with the state carried over give what one block gives.
        """
        ...


@runtime_checkable
class MayBeStatic(Protocol):
    """A model that may be one of the speed over the command alone."""

    def steady_curve(self, parameters: Array) -> SteadyCurve | None:
        """The curves of fans with these parameters; None where it knows the motion of the rotor."""
        ...


class Model(TwinModel, Protocol):
    """A model of some kind, with all that the card and the ONNX file need to know about it.

    fixed_rate: whether it is valid only at the sample rate it was trained at. used_parameters: the names of a fan's own
    parameters (twin.models.physics) that it uses.
    """

    kind: ClassVar[str]
    fixed_rate: ClassVar[bool]
    used_parameters: ClassVar[tuple[str, ...]]

    @property
    def network_card(self) -> NetworkCard:
        """The size of its network."""
        ...

    def graph(self) -> Nodes:
        """`advance` as ONNX nodes, between the inputs and outputs that schemas.twin_card names."""
        ...
