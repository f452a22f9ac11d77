"""One hidden layer of tanh units: W_o tanh(W_i x + b_i) + b_o (equation (28) of Peng and Chen).

Its inputs are the speed, or the speed and the command. It works on scaled quantities, so that its weights are of
order one whatever the units; the scaling belongs to it. theta holds all weights in one vector:
W_i by input (inputs * units), b_i (units), W_o (units), b_o (1). Ten units count 41 parameters with both inputs and
31 with the speed alone; with the three physical ones, 44 and 34.
"""

from dataclasses import dataclass, replace

import numpy as np

from fantwin.schemas.twin_card import NetworkCard
from fantwin.twin.runs import Array


@dataclass(frozen=True)
class Scaling:
    """Offsets and scales that bring speed, command and acceleration to order one."""

    speed_offset_rad_s: float
    speed_scale_rad_s: float
    command_offset: float
    command_scale: float
    acceleration_scale_rad_s2: float


@dataclass(frozen=True, eq=False)
class TanhNetwork:
    """An acceleration in rad/s^2 from speed and command, or from the speed alone. theta: (parameter_count,), in scaled
    units."""

    units: int
    inputs: tuple[str, ...]
    scaling: Scaling
    theta: Array

    @classmethod
    def zero(cls, units: int, inputs: tuple[str, ...], scaling: Scaling) -> "TanhNetwork":
        """A network with all weights zero."""
        return cls(units, inputs, scaling, np.zeros(units * (len(inputs) + 2) + 1))

    @property
    def parameter_count(self) -> int:
        """The length of theta."""
        return self.units * (len(self.inputs) + 2) + 1

    @property
    def card(self) -> NetworkCard:
        """Its size, for the twin card."""
        return NetworkCard(self.units, self.inputs, self.parameter_count)

    def with_theta(self, theta: Array) -> "TanhNetwork":
        """The same network with other weights."""
        return replace(self, theta=theta)

    def weights(self) -> tuple[Array, Array, Array, float]:
        """W_i (inputs, units), b_i (units,), W_o (units,) and b_o, in scaled units."""
        rows = self.theta[:-1].reshape(len(self.inputs) + 2, self.units)
        return rows[:-2], rows[-2], rows[-1], float(self.theta[-1])

    def physical_weights(self) -> tuple[Array, Array, Array, float]:
        """The same weights for inputs in rad/s and command units and an output in rad/s^2: W_i, b_i, W_o, b_o."""
        input_weights, input_bias, output_weights, output_bias = self.weights()
        offsets = np.array([self.scaling.speed_offset_rad_s, self.scaling.command_offset])[: len(self.inputs)]
        scales = np.array([self.scaling.speed_scale_rad_s, self.scaling.command_scale])[: len(self.inputs)]
        per_unit = input_weights / scales[:, np.newaxis]
        rate = self.scaling.acceleration_scale_rad_s2
        return per_unit, input_bias - offsets @ per_unit, rate * output_weights, rate * output_bias

    def hidden(self, speed_rad_s: Array, command: Array) -> Array:
        """(..., batch, units) outputs of the hidden layer."""
        input_weights, input_bias, _, _ = self.weights()
        scaled = self._scaled_inputs(speed_rad_s, command)
        pre = scaled[0][..., np.newaxis] * input_weights[0]
        pre += input_bias
        if len(scaled) == 2:
            pre += scaled[1][..., np.newaxis] * input_weights[1]
        return np.tanh(pre, out=pre)

    def acceleration(self, speed_rad_s: Array, command: Array) -> Array:
        """(..., batch) in rad/s^2."""
        _, _, output_weights, output_bias = self.weights()
        scaled = self.hidden(speed_rad_s, command) @ output_weights + output_bias
        return self.scaling.acceleration_scale_rad_s2 * scaled

    def slope(self, speed_rad_s: Array, command: Array) -> tuple[Array, Array]:
        """The acceleration and its derivative by speed, both (..., batch)."""
        input_weights, _, output_weights, output_bias = self.weights()
        hidden = self.hidden(speed_rad_s, command)
        rate = self.scaling.acceleration_scale_rad_s2
        per_speed = output_weights * (input_weights[0] / self.scaling.speed_scale_rad_s)
        # (1 - h^2) . p as sum(p) - h^2 . p saves one pass over the largest array.
        by_speed = per_speed.sum() - (hidden * hidden) @ per_speed
        return rate * (hidden @ output_weights + output_bias), rate * by_speed

    def linearise(self, speed_rad_s: Array, command: Array, by_theta: Array) -> tuple[Array, Array, Array]:
        """The acceleration and its derivatives by speed and by command (..., batch); those by theta (..., batch, P) are
        written into `by_theta`.
        """
        value, by_speed, by_command, hidden, by_bias = self._by_inputs(speed_rad_s, command)
        rate = self.scaling.acceleration_scale_rad_s2
        for index, scaled in enumerate(self._scaled_inputs(speed_rad_s, command)):
            of_input = by_theta[..., index * self.units : (index + 1) * self.units]
            np.multiply(by_bias, scaled[..., np.newaxis], out=of_input)
        by_theta[..., -2 * self.units - 1 : -self.units - 1] = by_bias
        np.multiply(rate, hidden, out=by_theta[..., -self.units - 1 : -1])
        by_theta[..., -1] = rate
        return value, by_speed, by_command

    def linearise_inputs(self, speed_rad_s: Array, command: Array) -> tuple[Array, Array, Array]:
        """`linearise` without the derivatives by theta."""
        value, by_speed, by_command, _, _ = self._by_inputs(speed_rad_s, command)
        return value, by_speed, by_command

    def _by_inputs(self, speed_rad_s: Array, command: Array) -> tuple[Array, Array, Array, Array, Array]:
        """`linearise_inputs`, and (..., batch, units) the hidden layer and the derivatives by its biases."""
        input_weights, _, output_weights, output_bias = self.weights()
        rate = self.scaling.acceleration_scale_rad_s2
        hidden = self.hidden(speed_rad_s, command)
        by_bias = hidden * hidden
        np.subtract(1.0, by_bias, out=by_bias)
        by_bias *= rate * output_weights
        by_speed = by_bias @ (input_weights[0] / self.scaling.speed_scale_rad_s)
        by_command = np.zeros_like(by_speed)
        if len(self.inputs) > 1:
            by_command = by_bias @ (input_weights[1] / self.scaling.command_scale)
        return rate * (hidden @ output_weights + output_bias), by_speed, by_command, hidden, by_bias

    def _scaled_inputs(self, speed_rad_s: Array, command: Array) -> tuple[Array, ...]:
        scale = self.scaling
        speed = (speed_rad_s - scale.speed_offset_rad_s) / scale.speed_scale_rad_s
        if len(self.inputs) == 1:
            return (speed,)
        return speed, (command - scale.command_offset) / scale.command_scale
