"""w' = physics + network, either of which may be missing: the equation of all models that are continuous in time.

Physical model: physics alone, equation (11) of Peng and Chen. Neural ODE: the network alone, (28). Hybrid: both, (31).
"""

from dataclasses import dataclass

import numpy as np

from fantwin.twin.models import physics
from fantwin.twin.models.network import TanhNetwork
from fantwin.twin.runs import Array


@dataclass(frozen=True, eq=False)
class FanEquation:
    """The right-hand side of a batch of fans, w' as a function of speed and command: arrays of any equal shape
    (..., batch). parameters: (batch, 4) or more, or None without physics.

    linearise gives the derivatives by the network's weights, if these are free, and then by J, alpha and C_D, as far as
    there are any.
    """

    parameters: Array | None
    network: TanhNetwork | None
    has_free_weights: bool = True

    def acceleration(self, speed_rad_s: Array, command: Array) -> Array:
        """(..., batch) in rad/s^2."""
        if self.network is None:
            return physics.acceleration(speed_rad_s, command, self._physics)
        learned = self.network.acceleration(speed_rad_s, command)
        if self.parameters is None:
            return learned
        return learned + physics.acceleration(speed_rad_s, command, self.parameters)

    def slope(self, speed_rad_s: Array, command: Array) -> tuple[Array, Array]:
        """The acceleration and its derivative by speed, both (..., batch)."""
        if self.network is None:
            known = physics.acceleration(speed_rad_s, command, self._physics)
            return known, physics.acceleration_by_speed(speed_rad_s, self._physics)
        learned, by_speed = self.network.slope(speed_rad_s, command)
        if self.parameters is None:
            return learned, by_speed
        return (
            learned + physics.acceleration(speed_rad_s, command, self.parameters),
            by_speed + physics.acceleration_by_speed(speed_rad_s, self.parameters),
        )

    def linearise(
        self, speed_rad_s: Array, command: Array, by_theta: Array | None = None
    ) -> tuple[Array, Array, Array, Array]:
        """The acceleration and its derivatives by speed and by command (..., batch), and by theta (..., batch, P).

        by_theta: an array to write the last one into.
        """
        weights = self.network.parameter_count if self.network is not None and self.has_free_weights else 0
        if by_theta is None:
            of_physics = 0 if self.parameters is None else physics.LAG
            by_theta = np.empty((*speed_rad_s.shape, weights + of_physics))
        value = by_speed = by_command = np.zeros_like(speed_rad_s)
        if self.network is not None and self.has_free_weights:
            value, by_speed, by_command = self.network.linearise(speed_rad_s, command, by_theta[..., :weights])
        elif self.network is not None:
            value, by_speed, by_command = self.network.linearise_inputs(speed_rad_s, command)
        if self.parameters is not None:
            value = value + physics.acceleration(speed_rad_s, command, self.parameters)
            by_speed = by_speed + physics.acceleration_by_speed(speed_rad_s, self.parameters)
            by_command = by_command + 1.0 / self.parameters[:, 0]
            physics.acceleration_by_parameters(speed_rad_s, command, self.parameters, by_theta[..., weights:])
        return value, by_speed, by_command, by_theta

    @property
    def _physics(self) -> Array:
        assert self.parameters is not None, "an equation needs physics or a network"
        return self.parameters
