"""The NARX network: the next speed from past speeds and commands, equations (21) to (24) of Peng and Chen.

x = [w_k .. w_{k-9}, u_k, u_{k-1} .. u_{k-10}], w_{k+1} = W_o tanh(W_i x + b_i) + b_o with 50 units: the tenth order has
ten speeds, and the present command beside ten delayed ones, so 50 * 21 + 50 + 50 + 1 = 1151 parameters. It is discrete:
it has no step length and no physics, and is valid only at the rate it was trained at. Irregular samples are treated as
if they had their median rate.
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from onnx import helper

from fantwin.schemas.twin_card import NetworkCard, StateLayout
from fantwin.twin.models.network import Scaling
from fantwin.twin.models.onnx_nodes import Nodes, double
from fantwin.twin.runs import Array

UNITS = 50
ORDER = 10
INPUTS = 2 * ORDER + 1
PARAMETER_COUNT = UNITS * (INPUTS + 2) + 1


@dataclass(frozen=True, eq=False)
class Narx:
    """theta: (1151,) in scaled units: W_i by input (21 * 50), b_i (50), W_o (50), b_o (1). Shapes as in TwinModel."""

    theta: Array
    scaling: Scaling
    state_layout: StateLayout = StateLayout(speed=ORDER, command=ORDER)

    kind: ClassVar[str] = "narx"
    fixed_rate: ClassVar[bool] = True
    used_parameters: ClassVar[tuple[str, ...]] = ()

    @property
    def network_card(self) -> NetworkCard:
        """The size of the network."""
        return NetworkCard(UNITS, ("speed", "command"), PARAMETER_COUNT)

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
        """Free run from state; see model.TwinModel. step_s and parameters are not used."""
        input_weights, input_bias, output_weights, output_bias = self.physical_weights()
        # Time runs forwards in memory, lags backwards in the weights: turned round once, a past is a plain slice.
        by_speed, by_command = input_weights[ORDER - 1 :: -1].T, input_weights[: ORDER - 1 : -1].T
        speeds = np.concatenate((state[:, ORDER - 1 :: -1].T, np.empty_like(command)))
        commands = np.concatenate((state[:, : ORDER - 1 : -1].T, command))
        bias = input_bias[:, np.newaxis]
        for k in range(len(command)):
            past, driven = speeds[k : k + ORDER], commands[k : k + ORDER + 1]
            speeds[k + ORDER] = output_weights @ np.tanh(by_speed @ past + by_command @ driven + bias) + output_bias
        final = np.column_stack((speeds[: -ORDER - 1 : -1].T, commands[: -ORDER - 1 : -1].T))
        return speeds[ORDER - 1 : -1].copy(), final

    def graph(self) -> Nodes:
        """`advance` as ONNX nodes: predict, then shift both delay lines by one. Fans are the rows of the state."""
        block, body = Nodes(), Nodes("step/")
        input_weights, input_bias, output_weights, output_bias = self.physical_weights()
        command = body.add("Unsqueeze", ["command_k", body.constant("column", [1], np.int64)], "command")
        speeds = body.slice("state_k", 1, 0, ORDER, "speeds")
        commands = body.slice("state_k", 1, ORDER, 2 * ORDER, "commands")
        regressors = body.add("Concat", [speeds, command, commands], "regressors", axis=1)
        weights, bias = body.constant("input_weights", input_weights), body.constant("hidden_bias", input_bias)
        hidden = body.add("Tanh", [body.add("Gemm", [regressors, weights, bias], "pre_activation")], "hidden")
        weights = body.constant("output_weights", output_weights[:, np.newaxis])
        bias = body.constant("bias", output_bias)
        following = body.add("Gemm", [hidden, weights, bias], "speed_next")
        kept_speeds = body.slice(speeds, 1, 0, ORDER - 1, "kept_speeds")
        kept_commands = body.slice(commands, 1, 0, ORDER - 1, "kept_commands")
        state = body.add("Concat", [following, kept_speeds, command, kept_commands], "state_next", axis=1)
        newest = body.slice("state_k", 1, 0, 1, "newest")
        present = body.add("Squeeze", [newest, body.constant("row", [1], np.int64)], "speed_now")
        size = self.state_layout.size
        one_step = helper.make_graph(
            body.nodes,
            "one_step",
            [double("state_k", ["fans", size]), double("command_k", ["fans"])],
            [double(state, ["fans", size]), double(present, ["fans"])],
            body.constants,
        )
        block.scan(one_step, ["state"], ["command"], ["state_out"], "speed_rad_s")
        return block


def regressor_rows(speed: Array, command: Array) -> Array:
    """(n, 21) past speeds and present and past commands at each sample, newest first, from (n,) each.

    Before the first sample, speed and command are what they are at the first.
    """
    speeds = np.concatenate((np.full(ORDER - 1, speed[0]), speed))
    commands = np.concatenate((np.full(ORDER, command[0]), command))
    return np.concatenate(
        (sliding_window_view(speeds, ORDER)[:, ::-1], sliding_window_view(commands, ORDER + 1)[:, ::-1]), axis=1
    )
