"""The model that a twin file holds: the inverse of the export, for hybrids.

The graph holds the weights of the network for rad/s and command units, so the network that is read has no scaling.
"""

from pathlib import Path

import numpy as np
import onnx
from onnx import numpy_helper

from fantwin.schemas.twin_card import TwinCard
from fantwin.twin.errors import TwinError
from fantwin.twin.models.drive import Drive
from fantwin.twin.models.hybrid import Hybrid
from fantwin.twin.models.network import Scaling, TanhNetwork
from fantwin.twin.runs import Array

UNSCALED = Scaling(0.0, 1.0, 0.0, 1.0, 1.0)


def stored_hybrid(path: Path, card: TwinCard) -> Hybrid:
    """The hybrid in a file. card: that of the file.

    Raises:
        TwinError: the twin is of another kind.
    """
    if card.kind != Hybrid.kind:
        raise TwinError(f"{path}: a {card.kind} twin has no physics beside a network; give a hybrid")
    weights = _constants(onnx.load(path).graph)
    try:
        by_input = [weights[name] for name in ("step/speed_weights", "step/command_weights") if name in weights]
        rows = [*by_input, weights["step/hidden_bias"], weights["step/output_weights"], weights["step/output_bias"]]
    except KeyError as error:
        raise TwinError(f"{path}: its graph has no {error.args[0]}; train it again") from error
    theta = np.concatenate([each.ravel() for each in rows])
    network = TanhNetwork(card.network.units, card.network.inputs, UNSCALED, theta)
    drive = card.drive
    model = Hybrid(network)
    return model if drive is None else model.with_drive(Drive(drive.turning_command, drive.kick_s, drive.rest_s))


def _constants(graph: onnx.GraphProto) -> dict[str, Array]:
    """By name, also those of the graphs within its nodes."""
    found = {each.name: numpy_helper.to_array(each) for each in graph.initializer}
    for node in graph.node:
        for attribute in node.attribute:
            if attribute.type == onnx.AttributeProto.GRAPH:
                found |= _constants(attribute.g)
    return found
