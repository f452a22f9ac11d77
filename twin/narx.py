"""The NARX network: the next speed from past speeds and commands, equations (21) to (24) of Peng and Chen.

x = [w_k .. w_{k-9}, u_k, u_{k-1} .. u_{k-10}], w_{k+1} = W_o tanh(W_i x + b_i) + b_o with 50 units: the tenth order has
ten speeds, and the present command beside ten delayed ones, so 50 * 21 + 50 + 50 + 1 = 1151 parameters. It is discrete:
it knows no step length and no physics, and holds only at the rate it was trained at.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from twin.network import Scaling
from twin.runs import Array
from twin.state import StateLayout

UNITS = 50
ORDER = 10
INPUTS = 2 * ORDER + 1
PARAMETER_COUNT = UNITS * (INPUTS + 2) + 1


@dataclass(frozen=True, eq=False)
class Narx:
    """theta: (1151,) in scaled units: W_i by input (21 * 50), b_i (50), W_o (50), b_o (1). Shapes as in TwinModel."""

    theta: Array
    scaling: Scaling
    kind: Literal["narx"] = "narx"
    state_layout: StateLayout = StateLayout(speed=ORDER, command=ORDER)

    def weights(self) -> tuple[Array, Array, Array, float]:
        """W_i (21, 50), b_i (50,), W_o (50,) and b_o, in scaled units."""
        rows = self.theta[:-1].reshape(INPUTS + 2, UNITS)
        return rows[:-2], rows[-2], rows[-1], float(self.theta[-1])

    def physical_weights(self) -> tuple[Array, Array, Array, float]:
        """The same weights for inputs in rad/s and command units and an output in rad/s: W_i, b_i, W_o, b_o."""
        input_weights, input_bias, output_weights, output_bias = self.weights()
        scale = self.scaling
        offsets = np.repeat((scale.speed_offset_rad_s, scale.command_offset), (ORDER, ORDER + 1))
        per_unit = (
            input_weights / np.repeat((scale.speed_scale_rad_s, scale.command_scale), (ORDER, ORDER + 1))[:, None]
        )
        output_offset = scale.speed_offset_rad_s + scale.speed_scale_rad_s * output_bias
        return per_unit, input_bias - offsets @ per_unit, scale.speed_scale_rad_s * output_weights, output_offset

    def advance(self, state: Array, command: Array, step_s: Array, parameters: Array) -> tuple[Array, Array]:
        """Free run from state; see models.TwinModel. step_s and parameters are not used."""
        input_weights, input_bias, output_weights, output_bias = self.physical_weights()
        speed_rad_s = np.empty_like(command)
        for k in range(len(command)):
            speed_rad_s[k] = state[:, 0]
            regressors = np.column_stack((state[:, :ORDER], command[k], state[:, ORDER:]))
            following = np.tanh(regressors @ input_weights + input_bias) @ output_weights + output_bias
            state = np.column_stack((following, state[:, : ORDER - 1], command[k], state[:, ORDER:-1]))
        return speed_rad_s, state
