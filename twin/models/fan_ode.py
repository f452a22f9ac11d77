"""Models that are continuous in time: what the physical model, the hybrid and the neural ODE share."""

from dataclasses import dataclass, field, replace
from typing import ClassVar, Self

import numpy as np

from fantwin.schemas.twin_card import NetworkCard, StateLayout
from fantwin.twin.models.drive import DRIVE_LAYOUT, Drive, drive_settings
from fantwin.twin.models.integration import free_run
from fantwin.twin.models.lag import effective_command
from fantwin.twin.models.network import TanhNetwork
from fantwin.twin.models.ode_graph import ode_graph
from fantwin.twin.models.onnx_nodes import Nodes
from fantwin.twin.models.physics import LAG
from fantwin.twin.models.right_hand_side import FanEquation
from fantwin.twin.runs import Array

ODE_LAYOUT = StateLayout(speed=1, command=1)
"""The one command is the lagged one (twin.models.lag)."""


@dataclass(frozen=True, eq=False)
class FanOde:
    """Physics of each fan, a network for all, or both. Shapes as in model.TwinModel."""

    network: TanhNetwork | None = None
    state_layout: StateLayout = field(default=ODE_LAYOUT, kw_only=True)
    drive: Drive | None = field(default=None, kw_only=True)

    kind: ClassVar[str]
    has_physics: ClassVar[bool]
    used_parameters: ClassVar[tuple[str, ...]]
    fixed_rate: ClassVar[bool] = False

    def with_drive(self, drive: Drive) -> Self:
        """The same model behind a drive; its parameters are then (fans, 7)."""
        return replace(self, drive=drive, state_layout=DRIVE_LAYOUT)

    def equation(self, parameters: Array) -> FanEquation:
        """w' of a batch of fans with the physical parameters (batch, 4), which enter only if the model has physics."""
        return FanEquation(parameters if self.has_physics else None, self.network)

    @property
    def theta(self) -> Array:
        """(P,) the weights of the network; empty without one."""
        return np.zeros(0) if self.network is None else self.network.theta

    @property
    def network_card(self) -> NetworkCard:
        """The size of the network."""
        return NetworkCard(units=0, inputs=(), parameter_count=0) if self.network is None else self.network.card

    def with_theta(self, theta: Array) -> Self:
        """The same model with other weights, if it has any."""
        return self if self.network is None else replace(self, network=self.network.with_theta(theta))

    def advance(self, state: Array, command: Array, step_s: Array, parameters: Array) -> tuple[Array, Array]:
        """Free run from a state: speed, lagged command and, with a drive, its charge; see model.TwinModel."""
        charge = state[:, 2:]
        if self.drive is not None:
            share, after = self.drive.kick(command, step_s[:, np.newaxis], state[:, 2])
            command = self.drive.effective(command, share, drive_settings(parameters))
            charge = after[:, np.newaxis]
        acting, lagged = effective_command(command, step_s[:, np.newaxis], parameters[:, LAG], state[:, 1])
        speed_rad_s, final = free_run(self.equation(parameters), state[:, 0], acting, step_s)
        return speed_rad_s, np.column_stack((final, lagged, charge))

    def graph(self) -> Nodes:
        """See model.Model."""
        return ode_graph(self.network, has_physics=self.has_physics, drive=self.drive)


@dataclass(frozen=True, eq=False)
class NetworkOde(FanOde):
    """One network for all fans, beside the physics of each fan or alone."""

    network: TanhNetwork = field()
