"""The physical model: w' = (tau - alpha w - C_D w|w|) / J, three parameters per fan."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from twin import physics
from twin.integration import free_run
from twin.runs import Array
from twin.state import ODE_LAYOUT, StateLayout


@dataclass(frozen=True, eq=False)
class PhysicalRightHandSide:
    """w' of the physical fan. parameters: (batch, 3).

    theta of linearise is what is fitted; by_theta: (batch, 3, 3), the parameters' derivatives by it.
    """

    parameters: Array
    by_theta: Array

    def acceleration(self, speed_rad_s: Array, command: Array) -> Array:
        """(..., batch) in rad/s^2."""
        return physics.acceleration(speed_rad_s, command, self.parameters)

    def linearise(self, speed_rad_s: Array, command: Array) -> tuple[Array, Array, Array]:
        """See integration.RightHandSide."""
        return (
            physics.acceleration(speed_rad_s, command, self.parameters),
            physics.acceleration_by_speed(speed_rad_s, self.parameters),
            np.einsum(
                "...bp,bpq->...bq",
                physics.acceleration_by_parameters(speed_rad_s, command, self.parameters),
                self.by_theta,
            ),
        )


def fitted_physics(theta: Array, top_speed_rad_s: Array) -> PhysicalRightHandSide:
    """The physical fan in the unknowns it is fitted in; see physical_parameters."""
    parameters = physical_parameters(theta, top_speed_rad_s)
    return PhysicalRightHandSide(parameters, parameters_by_unknowns(theta, top_speed_rad_s))


def physical_parameters(theta: Array, top_speed_rad_s: Array) -> Array:
    """(fans, 3) J, alpha, C_D from the logarithms of J, of the damping at rest and of the damping at top speed.

    The damping d torque / d speed is alpha + 2 C_D |w|. That it is positive at both ends makes the model stable at
    every recorded speed, which is all that physics demands: C_D may come out negative where friction or a dead zone
    bends the curve. theta: (fans, 3). top_speed_rad_s: (fans,), the largest recorded.
    """
    inertia, at_rest, at_top = np.exp(theta.T)
    return np.column_stack((inertia, at_rest, (at_top - at_rest) / (2.0 * top_speed_rad_s)))


def parameters_by_unknowns(theta: Array, top_speed_rad_s: Array) -> Array:
    """(fans, 3, 3) derivatives of J, alpha, C_D (rows) by the fitted unknowns (columns)."""
    inertia, at_rest, at_top = np.exp(theta.T)
    derivatives = np.zeros((len(theta), 3, 3))
    derivatives[:, 0, 0] = inertia
    derivatives[:, 1, 1] = at_rest
    derivatives[:, 2, 1] = -at_rest / (2.0 * top_speed_rad_s)
    derivatives[:, 2, 2] = at_top / (2.0 * top_speed_rad_s)
    return derivatives


def fitted_unknowns(parameters: Array, top_speed_rad_s: Array) -> Array:
    """(fans, 3) the inverse of physical_parameters. Damping that is not positive becomes a hundredth of the larger."""
    inertia, viscous, drag = parameters.T
    damping = np.stack((viscous, viscous + 2.0 * drag * top_speed_rad_s))
    return np.log(np.column_stack((inertia, *np.maximum(damping, 0.01 * np.abs(damping).max(axis=0)))))


@dataclass(frozen=True)
class PhysicalModel:
    """Physics alone. Shapes as in models.TwinModel."""

    kind: Literal["physical"] = "physical"
    state_layout: StateLayout = ODE_LAYOUT

    def advance(self, state: Array, command: Array, step_s: Array, parameters: Array) -> tuple[Array, Array]:
        """Free run from state; see models.TwinModel."""
        rhs = PhysicalRightHandSide(parameters, np.tile(np.eye(3), (len(parameters), 1, 1)))
        speed_rad_s, final = free_run(rhs.acceleration, state[:, 0], command, step_s)
        return speed_rad_s, final[:, np.newaxis]
