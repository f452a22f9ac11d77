"""A twin as one ONNX file in float64: the graph of its model, with the card in its metadata.

    inputs   state (fans, n_state)         see schemas.twin_card.StateLayout
             command (n, fans)             held from sample k to k + 1
             step_s (n,)                   time from sample k to k + 1
             parameters (fans, n)          in the order of the card's parameter_names
    outputs  speed_rad_s (n, fans)         at sample k, before command k acts
             state_out (fans, n_state)     after the last step: the next block's state

fans and n are dynamic. A graph has all four inputs, whether its model needs them or not, so that all kinds of model
look the same to a reader.
"""

import json
from collections.abc import Mapping
from typing import Any

import onnx
from onnx import checker, helper

from fantwin.schemas.twin_card import CARD_PROPERTY, TwinCard
from fantwin.twin.errors import TwinError
from fantwin.twin.models.model import Model
from fantwin.twin.models.onnx_nodes import double

OPSET = 17
IR_VERSION = 8


def export_onnx(model: Model, card: TwinCard) -> bytes:
    """The serialised file. The same model and card give the same bytes."""
    width = model.state_layout.size
    nodes = model.graph()
    graph = helper.make_graph(
        nodes.nodes,
        "fantwin",
        [
            double("state", ["fans", width]),
            double("command", ["n", "fans"]),
            double("step_s", ["n"]),
            double("parameters", ["fans", len(card.parameter_names)]),
        ],
        [double("speed_rad_s", ["n", "fans"]), double("state_out", ["fans", width])],
        nodes.constants,
    )
    file = helper.make_model(
        graph, producer_name="fantwin", opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR_VERSION
    )
    helper.set_model_props(file, {CARD_PROPERTY: card.to_json()})
    checker.check_model(file, full_check=True)
    return file.SerializeToString(deterministic=True)


def with_card_entries(content: bytes, entries: Mapping[str, Any]) -> bytes:
    """The same ONNX file with other entries in its card, such as its calibration or its name.

    The graph and its weights are unchanged.

    Raises:
        TwinError: it is no twin.
    """
    model = onnx.load_model_from_string(content)
    for entry in model.metadata_props:
        if entry.key == CARD_PROPERTY:
            card = json.loads(entry.value)
            entry.value = json.dumps({**card, **entries}, allow_nan=False)
            return model.SerializeToString()
    raise TwinError(f"an ONNX file, but not a twin: it has no {CARD_PROPERTY}")
