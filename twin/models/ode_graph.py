"""FanOde.advance as ONNX nodes: a Scan over samples whose body is the lag and one Runge-Kutta step.

The nodes are written by hand, and few: each costs a third of a microsecond or more, whatever it computes for a tray of
fans. A layer of the network with its bias is one node (Gemm), and so is the advance of a Runge-Kutta stage. What does
not depend on the speed is computed once for the four stages; what does not depend on the sample, once for the block.
Fans lie side by side in rows (1, fans), so that products with weights are long in their inner loop. Everything whose
shape varies with the block is computed sample by sample or is exact, so that the numbers do not depend on how a run is
cut into blocks.
"""

from collections.abc import Callable

import numpy as np
from onnx import helper

from fantwin.twin.models.drive import DRIVE_PARAMETERS, SMALLEST_STEP_S, Drive
from fantwin.twin.models.network import TanhNetwork
from fantwin.twin.models.onnx_nodes import Nodes, double
from fantwin.twin.models.physics import PARAMETER_NAMES

RK4_WEIGHTS = np.array([[1.0, 2.0, 2.0, 1.0]]) / 6.0

Term = Callable[[str], str]
"""The name of a speed (1, fans) to the name of what depends on it."""


def ode_graph(network: TanhNetwork | None, *, has_physics: bool, drive: Drive | None = None) -> Nodes:
    """The nodes of a model w' = physics + network, either of which may be missing."""
    block, body = Nodes(), Nodes("step/")
    states = block.rows("state", ["speed", "lagged"] if drive is None else ["speed", "lagged", "charge"], "state_rows")
    names = PARAMETER_NAMES if drive is None else PARAMETER_NAMES + DRIVE_PARAMETERS
    parameters: dict[str, str] = dict(zip(names, block.rows("parameters", list(names), "turned"), strict=True))
    step_s = block.add("Unsqueeze", ["step_s", block.constant("step_axes", [1, 2], np.int64)], "step")
    exponent = _decay_exponent(block, step_s, parameters["lag_s"])

    row: list[str | int] = [1, "fans"]
    command, charges, charges_after = "command_k", [], []
    if drive is not None:
        command, charge_after = drive.nodes(body, [parameters[name] for name in DRIVE_PARAMETERS])
        charges, charges_after = [double("charge_k", row)], [double(charge_after, row)]
    acting, lagged = _lag(body, command)
    speed = _rk4_step(body, _acceleration(network, has_physics, block, body, parameters, acting))
    present = body.add("Identity", ["speed_k"], "speed_now")
    one_step = helper.make_graph(
        body.nodes,
        "one_step",
        [
            double("speed_k", row),
            double("lagged_k", row),
            *charges,
            double("command_k", ["fans"]),
            double("step_k", [1, 1]),
            double("exponent_k", row),
        ],
        [double(speed, row), double(lagged, row), *charges_after, double(present, row)],
        body.constants,
    )
    finals = ["speed_final", "lagged_final", *(["charge_final"] if drive else [])]
    block.scan(one_step, states, ["command", step_s, exponent], finals, "speed_rows")
    block.add("Squeeze", ["speed_rows", block.constant("row_axis", [1], np.int64)], "speed_rad_s")
    block.add("Transpose", [block.add("Concat", finals, "final_rows", axis=0)], "state_out", perm=[1, 0])
    return block


def _decay_exponent(block: Nodes, step_s: str, lag_s: str) -> str:
    """(n, 1, fans) minus step over lag: minus infinity where there is no lag."""
    smallest = block.constant("smallest_step_s", SMALLEST_STEP_S)
    return block.add(
        "Div", [block.add("Max", [step_s, smallest], "positive_step"), block.add("Neg", [lag_s], "minus_lag")], "decays"
    )


def _lag(body: Nodes, command: str) -> tuple[str, str]:
    """lag.effective_command for one sample's command: the one that acts, and the lagged one after the step.

    Without a lag both are the command itself, to the last bit. 1 - exp(-x) loses digits where steps are much shorter
    than the lag: of sixteen digits, one for each zero of x = step / lag after the decimal point.
    """
    # The exponential belongs in here: over a whole block its last bit would depend on a sample's place in it.
    decay = body.add("Exp", ["exponent_k"], "decay")
    lost = body.add("Sub", [decay, body.constant("one", 1.0)], "lost")
    mean_share = body.add("Div", [lost, "exponent_k"], "mean_share")
    distance = body.add("Sub", ["lagged_k", command], "distance")
    acting = body.add("Add", [command, body.add("Mul", [distance, mean_share], "mean_left")], "acting")
    lagged = body.add("Add", [command, body.add("Mul", [distance, decay], "left")], "lagged_next")
    return acting, lagged


def _rk4_step(body: Nodes, acceleration: Term) -> str:
    """integration.rk4_step node by node."""
    half_step = body.add("Mul", ["step_k", body.constant("half", 0.5)], "half_step")
    weights = body.add("Mul", ["step_k", body.constant("rk4_weights", RK4_WEIGHTS)], "stage_steps")
    slopes: list[str] = []
    speed = "speed_k"
    for stage, reach in enumerate((half_step, half_step, "step_k", None), start=1):
        with body.scope(f"k{stage}"):
            slopes.append(acceleration(speed))
            if reach is not None:
                speed = body.add("Gemm", [reach, slopes[-1], "speed_k"], "speed_there")
    return body.add("Gemm", [weights, body.add("Concat", slopes, "slopes", axis=0), "speed_k"], "speed_next")


def _acceleration(
    network: TanhNetwork | None, has_physics: bool, block: Nodes, body: Nodes, parameters: dict[str, str], acting: str
) -> Term:
    """right_hand_side.FanEquation. tau / J + b_o does not depend on the speed: it is the same in all four stages."""
    forcing, load, hidden, weights = "", None, None, ""
    if has_physics:
        forcing = body.add("Div", [acting, parameters["J"]], "drive")
        load = _load(block, body, parameters)
    if network is not None:
        _, _, output_weights, output_bias = network.physical_weights()
        weights, bias = body.constant("output_weights", [output_weights]), body.constant("output_bias", [[output_bias]])
        forcing = body.add("Add", [forcing, bias], "forcing") if forcing else bias
        hidden = _hidden_layer(network, body, acting)

    def acceleration(speed: str) -> str:
        known = body.add("Sub", [forcing, load(speed)], "known") if load else forcing
        return body.add("Gemm", [weights, hidden(speed), known], "acceleration") if hidden else known

    return acceleration


def _load(block: Nodes, body: Nodes, parameters: dict[str, str]) -> Term:
    """(alpha + C_D |w|) w / J. The quotients are taken once for the block."""
    viscous = block.add("Div", [parameters["alpha"], parameters["J"]], "viscous_per_s")
    drag = block.add("Div", [parameters["C_D"], parameters["J"]], "drag_per_rad")

    def load(speed: str) -> str:
        turning = body.add("Mul", [drag, body.add("Abs", [speed], "turning")], "drag_damping")
        return body.add("Mul", [body.add("Add", [viscous, turning], "damping"), speed], "load")

    return load


def _hidden_layer(network: TanhNetwork, body: Nodes, acting: str) -> Term:
    """TanhNetwork.hidden, (units, fans). The command's share is the same in all four stages."""
    input_weights, input_bias, _, _ = network.physical_weights()
    speed_weights = body.constant("speed_weights", input_weights[:1].T)
    bias = body.constant("hidden_bias", input_bias[:, np.newaxis])
    if len(network.inputs) > 1:
        bias = body.add("Gemm", [body.constant("command_weights", input_weights[1:].T), acting, bias], "command_bias")

    def hidden(speed: str) -> str:
        return body.add("Tanh", [body.add("Gemm", [speed_weights, speed, bias], "pre_activation")], "hidden")

    return hidden
