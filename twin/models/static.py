"""The static model: the speed over the command, for samples that are too far apart to show the motion of the rotor.

Between two samples a fan goes all or most of the way to its steady speed S(command), and the command may have changed
at any time in between. x_k is the speed as if the command had changed with the sample, and w_k the one expected:

    w_k = x_k + c (S(u_k) - S(u_k-1)),          c = unknown_time (1 - (1 - a) time constant / step)
    x_k+1 = a w_k + (1 - a) S(u_k),             a = exp(-step / time constant)

c is the mean share of a change that the sample after it shows. unknown_time is 1 where commands change at any time
within a step. It is 0 where they change with the samples, as in the log of a controller: then this is a linear fan. S
is linear between knots of the command, which all fans have in common. Steps may be of any length.
"""

from dataclasses import dataclass
from itertools import pairwise
from typing import ClassVar

import numpy as np
from onnx import helper

from fantwin.schemas.steady_curve import SteadyCurve
from fantwin.schemas.twin_card import STATIC_PARAMETERS, NetworkCard, StateLayout
from fantwin.twin.models.onnx_nodes import Nodes, double
from fantwin.twin.models.recursion import linear_recursion
from fantwin.twin.runs import Array

TO_END = np.iinfo(np.int64).max
SHORTEST_STEP = 1e-4
"""time constants: the share of a change that a shorter step shows would be lost to rounding, and is next to nothing"""


@dataclass(frozen=True, eq=False)
class StaticModel:
    """Parameters of a fan, (fans, 2 + K): those of STATIC_PARAMETERS, and its steady speeds at the knots.

    knots: (K,) rising commands. The state is x_k and the command before. Shapes as in model.TwinModel.
    """

    knots: Array
    state_layout: StateLayout = StateLayout(speed=1, command=1)

    kind: ClassVar[str] = "static"
    fixed_rate: ClassVar[bool] = False

    def steady_curve(self, parameters: Array) -> SteadyCurve:
        """The curves of fans with these parameters."""
        return SteadyCurve(self.knots, parameters[:, len(STATIC_PARAMETERS) :], parameters[:, 0])

    @property
    def used_parameters(self) -> tuple[str, ...]:
        """See model.Model."""
        return (*STATIC_PARAMETERS, *(f"speed_at_{knot:.6g}" for knot in self.knots))

    @property
    def network_card(self) -> NetworkCard:
        """There is no network."""
        return NetworkCard(units=0, inputs=(), parameter_count=0)

    def hats(self, command: Array) -> Array:
        """(..., K) share of the speed at each knot in the steady speed of a command."""
        place = np.interp(command, self.knots, np.arange(len(self.knots)))
        return np.maximum(0.0, 1.0 - np.abs(place[..., np.newaxis] - np.arange(len(self.knots))))

    def advance(self, state: Array, command: Array, step_s: Array, parameters: Array) -> tuple[Array, Array]:
        """See model.TwinModel, but a command acts before its sample: when it changed is not known."""
        steady = self.steady_curve(parameters).speed_rad_s(np.vstack((state[:, 1], command)))
        expected, held = follow(steady, state[:, 0], step_s, parameters[:, 0], parameters[:, 1])
        return expected, np.column_stack((held, command[-1]))

    def graph(self) -> Nodes:
        """`advance` as ONNX nodes."""
        block, body = Nodes(), Nodes("step/")
        one, axis = block.constant("one", 1.0), block.constant("axis", [1], np.int64)
        speed, before = block.rows("state", ["speed", "before"], "state_rows")
        commands = block.add("Concat", [before, "command"], "commands", axis=0)
        names = ["time_constant", "unknown_time", *(f"speed_{k}" for k in range(len(self.knots)))]
        time_constant, unknown_time, *speeds = block.rows("parameters", names, "parameter_rows")
        steady = speeds[0]
        for k, (low, high) in enumerate(pairwise(self.knots.tolist())):
            at_low, within = block.constant(f"low_{k}", low), commands  # it goes on straight beyond the last ones
            if k > 0:
                within = block.add("Max", [within, at_low], f"above_{k}")
            if high < self.knots[-1]:
                within = block.add("Min", [within, block.constant(f"high_{k}", high)], f"within_{k}")
            beyond = block.add("Sub", [within, at_low], f"beyond_{k}")
            share = block.add("Div", [beyond, block.constant(f"width_{k}", high - low)], f"share_{k}")
            rise = block.add("Sub", [speeds[k + 1], speeds[k]], f"rise_{k}")
            steady = block.add("Add", [steady, block.add("Mul", [share, rise], f"gain_{k}")], f"steady_{k}")
        present, past = block.slice(steady, 0, 1, TO_END, "present"), block.slice(steady, 0, 0, -1, "past")
        periods = block.add("Div", [block.add("Unsqueeze", ["step_s", axis], "steps"), time_constant], "periods")
        stays = block.add("Exp", [block.add("Neg", [periods], "minus_periods")], "stays")
        goes = block.add("Sub", [one, stays], "goes")
        some = block.add("Max", [periods, block.constant("shortest", SHORTEST_STEP)], "some")
        missing = block.add("Sub", [one, block.add("Exp", [block.add("Neg", [some], "minus_some")], "left")], "missing")
        seen = block.add("Sub", [one, block.add("Div", [missing, some], "not_yet")], "seen")
        at_once = block.add("Mul", [unknown_time, seen], "at_once")
        ahead = block.add("Mul", [at_once, block.add("Sub", [present, past], "change")], "ahead")
        parts = [block.add("Mul", [stays, ahead], "kept_ahead"), block.add("Mul", [goes, present], "reached")]
        forcing = block.add("Add", parts, "forcing")
        following = body.add("Add", [body.add("Mul", ["stays_k", "held_k"], "kept"), "forcing_k"], "held_next")
        held = body.add("Identity", ["held_k"], "held_now")
        one_step = helper.make_graph(
            body.nodes,
            "one_step",
            [double(name, ["fans"]) for name in ("held_k", "stays_k", "forcing_k")],
            [double(following, ["fans"]), double(held, ["fans"])],
            body.constants,
        )
        row = block.constant("row", [0], np.int64)
        block.scan(one_step, [block.add("Squeeze", [speed, row], "start")], [stays, forcing], ["end"], "held")
        block.add("Add", ["held", ahead], "speed_rad_s")
        ends = [block.add("Unsqueeze", ["end", row], "end_row"), block.slice(commands, 0, -1, TO_END, "newest")]
        block.add("Transpose", [block.add("Concat", ends, "ends", axis=0)], "state_out", perm=[1, 0])
        return block


def follow(
    steady: Array, start: Array, step_s: Array, time_constant_s: Array, unknown_time: Array
) -> tuple[Array, Array]:
    """The expected w (n, m), and x after the last step (m,), of columns whose steady values are these, (n + 1, m), from
    that before the first sample on. start: x at the first sample, (m,). step_s: (n,). The others: of each column."""
    periods = step_s[:, np.newaxis] / time_constant_s
    stays = np.exp(-periods)
    some = np.maximum(periods, SHORTEST_STEP)
    ahead = unknown_time * (1.0 + np.expm1(-some) / some) * np.diff(steady, axis=0)
    held = linear_recursion(stays, np.vstack((start, stays * ahead + (1.0 - stays) * steady[1:])))
    return held[:-1] + ahead, held[-1]
