"""A twin as one ONNX file: a Scan over samples whose body is one step of the model, in float64, with the card inside.

    inputs   state (fans, n_state)         speed_k .. then past commands; see state.StateLayout
             command (n, fans)             held from sample k to k + 1
             step_s (n,)                   time from sample k to k + 1
             parameters (fans, 3)          J, alpha, C_D of each fan
    outputs  speed_rad_s (n, fans)         at sample k, before command k acts
             state_out (fans, n_state)     after the last step: the next block's state

fans and n are dynamic. Every kind has all four inputs, whether it needs them or not, so that a reader needs to know
one contract only. The nodes are written by hand: the graph is small, and each is one term of the model.
"""

from collections.abc import Callable

import numpy as np
from onnx import checker, helper

from twin.card import CARD_KEY, Card
from twin.hybrid import Hybrid
from twin.models import Model, NetworkOde
from twin.narx import ORDER, Narx
from twin.network import TanhNetwork
from twin.onnx_graph import Nodes, double
from twin.physical import PhysicalModel
from twin.physics import PARAMETER_NAMES

OPSET = 17
IR_VERSION = 8

Term = Callable[[str], str]
"""The name of a speed (fans, 1) to the name of an acceleration (fans, 1)."""


def export_onnx(model: Model, card: Card) -> bytes:
    """The serialised file. The same model and card give the same bytes."""
    outer, body = Nodes(), Nodes("step/")
    width = model.state_layout.size
    command = body.add("Unsqueeze", ["command_k", body.constant("column", [1], np.int64)], "command")
    following = _narx_step(model, body, command) if isinstance(model, Narx) else _ode_step(model, outer, body, command)
    speed = body.add(
        "Squeeze", [body.slice("state_k", 1, 0, 1, "newest"), body.constant("row", [1], np.int64)], "speed_k"
    )
    step = helper.make_graph(
        body.nodes,
        "one_step",
        [double("state_k", ["fans", width]), double("command_k", ["fans"]), double("step_k", [])],
        [double(following, ["fans", width]), double(speed, ["fans"])],
        body.constants,
    )
    scan = helper.make_node(
        "Scan",
        ["state", "command", "step_s"],
        ["state_out", "speed_rad_s"],
        name="free_run",
        body=step,
        num_scan_inputs=2,
    )
    graph = helper.make_graph(
        [*outer.nodes, scan],
        "fantwin",
        [
            double("state", ["fans", width]),
            double("command", ["n", "fans"]),
            double("step_s", ["n"]),
            double("parameters", ["fans", len(PARAMETER_NAMES)]),
        ],
        [double("speed_rad_s", ["n", "fans"]), double("state_out", ["fans", width])],
        outer.constants,
    )
    file = helper.make_model(
        graph, producer_name="fantwin", opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR_VERSION
    )
    helper.set_model_props(file, {CARD_KEY: card.to_json()})
    checker.check_model(file, full_check=True)
    return file.SerializeToString(deterministic=True)


def _ode_step(model: PhysicalModel | NetworkOde, outer: Nodes, body: Nodes, command: str) -> str:
    """One RK4 step of an ordinary differential equation, integration.rk4_step node by node."""
    terms: list[Term] = []
    if isinstance(model, PhysicalModel | Hybrid):
        terms.append(_physics_term(outer, body, command))
    if not isinstance(model, PhysicalModel):
        terms.append(_network_term(model.network, body, command))

    def acceleration(speed: str) -> str:
        values = [term(speed) for term in terms]
        return values[0] if len(values) == 1 else body.add("Add", values, "acceleration")

    half, two, six = (body.constant(name, value) for name, value in (("half", 0.5), ("two", 2.0), ("six", 6.0)))
    half_step = body.add("Mul", ["step_k", half], "half_step_s")
    slopes: list[str] = []
    speed = "state_k"
    for stage, reach in enumerate((half_step, half_step, "step_k", None), start=1):
        with body.scope(f"k{stage}"):
            slopes.append(acceleration(speed))
            if reach is not None:
                speed = body.add("Add", ["state_k", body.add("Mul", [reach, slopes[-1]], "advance")], "speed_there")
    middle = body.add("Mul", [two, body.add("Add", [slopes[1], slopes[2]], "k2_k3")], "middle")
    total = body.add("Add", [body.add("Add", [slopes[0], middle], "k1_k2_k3"), slopes[3]], "slope_sum")
    sixth_step = body.add("Div", ["step_k", six], "sixth_step_s")
    return body.add("Add", ["state_k", body.add("Mul", [sixth_step, total], "change")], "state_next")


def _physics_term(outer: Nodes, body: Nodes, command: str) -> Term:
    """physics.acceleration. The parameters' columns are cut out once, outside the loop."""
    inertia, viscous, drag = (
        outer.slice("parameters", 1, column, column + 1, name) for column, name in enumerate(PARAMETER_NAMES)
    )

    def term(speed: str) -> str:
        damping = body.add("Mul", [drag, body.add("Abs", [speed], "turning")], "drag_damping")
        load = body.add("Mul", [body.add("Add", [viscous, damping], "damping"), speed], "load")
        return body.add("Div", [body.add("Sub", [command, load], "net_torque"), inertia], "physics")

    return term


def _network_term(network: TanhNetwork, body: Nodes, command: str) -> Term:
    """TanhNetwork.acceleration. The command's share of the hidden layer is the same in all four stages."""
    input_weights, input_bias, output_weights, output_bias = network.physical_weights()
    speed_weights = body.constant("speed_weights", input_weights[:1])
    bias = body.constant("hidden_bias", input_bias)
    if len(network.inputs) > 1:
        command_weights = body.constant("command_weights", input_weights[1:])
        bias = body.add("Add", [body.add("Mul", [command, command_weights], "command_share"), bias], "command_bias")
    output = body.constant("output_weights", output_weights[:, np.newaxis])
    constant = body.constant("output_bias", output_bias)

    def term(speed: str) -> str:
        pre = body.add("Add", [body.add("Mul", [speed, speed_weights], "speed_share"), bias], "pre_activation")
        weighted = body.add("MatMul", [body.add("Tanh", [pre], "hidden"), output], "weighted")
        return body.add("Add", [weighted, constant], "network")

    return term


def _narx_step(model: Narx, body: Nodes, command: str) -> str:
    """Narx.advance for one sample: predict, then shift both delay lines by one."""
    input_weights, input_bias, output_weights, output_bias = model.physical_weights()
    speeds = body.slice("state_k", 1, 0, ORDER, "speeds")
    commands = body.slice("state_k", 1, ORDER, 2 * ORDER, "commands")
    regressors = body.concat([speeds, command, commands], "regressors")
    weighted = body.add("MatMul", [regressors, body.constant("input_weights", input_weights)], "input_share")
    hidden = body.add("Tanh", [body.add("Add", [weighted, body.constant("hidden_bias", input_bias)], "pre")], "hidden")
    output = body.add("MatMul", [hidden, body.constant("output_weights", output_weights[:, np.newaxis])], "weighted")
    following = body.add("Add", [output, body.constant("output_bias", output_bias)], "speed_next")
    kept_speeds = body.slice(speeds, 1, 0, ORDER - 1, "kept_speeds")
    kept_commands = body.slice(commands, 1, 0, ORDER - 1, "kept_commands")
    return body.concat([following, kept_speeds, command, kept_commands], "state_next")
