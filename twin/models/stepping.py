"""A free run of many fans, sample after sample, without the temporary arrays of `right_hand_side.FanEquation`.

With many fans, creating temporary arrays takes a large part of a step. What does not change from step to step, or
depends on the command alone, is calculated once, and every result is written where it is needed next. The operations
and their order are those of `integration.rk4_step` and of the acceleration of FanEquation: the speeds differ only by
rounding.
"""

import numpy as np

from fantwin.twin.models.network import TanhNetwork
from fantwin.twin.models.physics import LAG
from fantwin.twin.runs import Array


class NetworkTerm:
    """The acceleration of a network, of one batch."""

    def __init__(self, network: TanhNetwork, batch: int) -> None:
        input_weights, input_bias, output_weights, self._output_bias = network.weights()
        self._scaling = network.scaling
        self._has_command = len(network.inputs) > 1
        self._by_speed, self._by_command = input_weights[0], input_weights[-1]
        self._output_weights = np.ascontiguousarray(output_weights)
        self._bias = np.tile(input_bias, (batch, 1))
        self._of_command, self._hidden = np.empty_like(self._bias), np.empty_like(self._bias)
        self._scaled = np.empty(batch)

    def hold(self, command: Array) -> None:
        """Take these commands (batch,) from now on."""
        if self._has_command:
            np.subtract(command, self._scaling.command_offset, out=self._scaled)
            np.divide(self._scaled, self._scaling.command_scale, out=self._scaled)
            np.multiply(self._scaled[:, np.newaxis], self._by_command, out=self._of_command)

    def acceleration(self, speed_rad_s: Array, out: Array) -> None:
        """Write it, (batch,) in rad/s^2, into `out`."""
        scaled, hidden = self._scaled, self._hidden
        np.subtract(speed_rad_s, self._scaling.speed_offset_rad_s, out=scaled)
        np.divide(scaled, self._scaling.speed_scale_rad_s, out=scaled)
        np.multiply(scaled[:, np.newaxis], self._by_speed, out=hidden)
        np.add(hidden, self._bias, out=hidden)
        if self._has_command:
            np.add(hidden, self._of_command, out=hidden)
        np.tanh(hidden, out=hidden)
        np.matmul(hidden, self._output_weights, out=out)
        np.add(out, self._output_bias, out=out)
        np.multiply(out, self._scaling.acceleration_scale_rad_s2, out=out)


class PhysicsTerm:
    """The acceleration of the physics, of one batch. parameters: (batch, 4)."""

    def __init__(self, parameters: Array) -> None:
        self._inertia, self._viscous, self._drag = np.ascontiguousarray(parameters.T[:LAG])
        self._command = self._inertia

    def hold(self, command: Array) -> None:
        """Take these commands (batch,) from now on."""
        self._command = command

    def acceleration(self, speed_rad_s: Array, out: Array) -> None:
        """Write it, (batch,) in rad/s^2, into `out`."""
        np.abs(speed_rad_s, out=out)
        np.multiply(out, self._drag, out=out)
        np.add(out, self._viscous, out=out)
        np.multiply(out, speed_rad_s, out=out)
        np.subtract(self._command, out, out=out)
        np.divide(out, self._inertia, out=out)


def step_fans(
    network: TanhNetwork | None, parameters: Array | None, initial_speed_rad_s: Array, command: Array, step_s: Array
) -> tuple[Array, Array]:
    """integration.free_run sample by sample, of a network, of physics or of the sum of both.

    parameters: (batch, 4) or more, or None without physics. step_s: (n, batch).
    """
    batch = command.shape[1]
    of_network = NetworkTerm(network, batch) if network is not None else None
    of_physics = PhysicsTerm(parameters) if parameters is not None else None
    known = np.empty(batch)

    def acceleration(speed_rad_s: Array, out: Array) -> None:
        if of_network is None:
            assert of_physics is not None, "an equation needs physics or a network"
            of_physics.acceleration(speed_rad_s, out)
            return
        of_network.acceleration(speed_rad_s, out)
        if of_physics is not None:
            of_physics.acceleration(speed_rad_s, known)
            np.add(out, known, out=out)

    # Rows that lie side by side are read and written several times as fast; the result lies as the commands do.
    rows, current = np.empty(command.shape), np.array(initial_speed_rad_s, dtype=np.float64)
    k1, k2, k3, k4, reached, half_s = (np.empty(batch) for _ in range(6))
    for speed_rad_s, held, whole_s in zip(
        rows, np.ascontiguousarray(command), np.ascontiguousarray(step_s), strict=True
    ):
        speed_rad_s[:] = current
        for term in (of_network, of_physics):
            if term is not None:
                term.hold(held)
        np.multiply(whole_s, 0.5, out=half_s)
        acceleration(current, k1)
        for k, before, reach_s in ((k2, k1, half_s), (k3, k2, half_s), (k4, k3, whole_s)):
            np.multiply(reach_s, before, out=reached)
            np.add(reached, current, out=reached)
            acceleration(reached, k)
        np.add(k2, k3, out=k2)
        np.multiply(k2, 2.0, out=k2)
        np.add(k1, k2, out=k1)
        np.add(k1, k4, out=k1)
        np.divide(whole_s, 6.0, out=half_s)
        np.multiply(half_s, k1, out=k1)
        np.add(current, k1, out=current)
    speeds_rad_s = np.empty_like(command)
    speeds_rad_s[:] = rows
    return speeds_rad_s, current
