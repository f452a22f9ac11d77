"""An exported twin, run by onnxruntime like a model in memory, so that the file itself is evaluated."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from onnx import numpy_helper

from fantwin.schemas.steady_curve import SteadyCurve
from fantwin.schemas.twin_card import CARD_PROPERTY, GRAPH_INPUTS, GRAPH_OUTPUTS, CardError, StateLayout, TwinCard
from fantwin.twin.errors import TwinError
from fantwin.twin.models.drive import Drive
from fantwin.twin.models.fan_ode import FanOde
from fantwin.twin.models.hybrid import Hybrid
from fantwin.twin.models.network import Scaling, TanhNetwork
from fantwin.twin.models.neural_ode import NeuralOde
from fantwin.twin.models.physical import PhysicalModel
from fantwin.twin.runs import Array

UNSCALED = Scaling(0.0, 1.0, 0.0, 1.0, 1.0)


def stored_ode(path: Path, content: bytes, card: TwinCard) -> FanOde:
    """The model, continuous in time, that the content of a twin file holds: the inverse of the export. card: that of
    the file.

    The graph holds the weights of the network for rad/s and command units, so the network that is read has no scaling.

    Raises:
        TwinError: the twin is of another kind.
    """
    makes: dict[str, Callable[[TanhNetwork], FanOde]] = {Hybrid.kind: Hybrid, NeuralOde.kind: NeuralOde}
    if card.kind == PhysicalModel.kind:
        model: FanOde = PhysicalModel()
    elif card.kind in makes:
        model = makes[card.kind](_stored_network(path, content, card))
    else:
        raise TwinError(
            f"{path}: a {card.kind} twin is not continuous in time; give a hybrid, neural ODE or physical one"
        )
    drive = card.drive
    return model if drive is None else model.with_drive(Drive(drive.turning_command, drive.kick_s, drive.rest_s))


def _stored_network(path: Path, content: bytes, card: TwinCard) -> TanhNetwork:
    weights = _constants(onnx.load_from_string(content).graph)
    try:
        by_input = [weights[name] for name in ("step/speed_weights", "step/command_weights") if name in weights]
        rows = [*by_input, weights["step/hidden_bias"], weights["step/output_weights"], weights["step/output_bias"]]
    except KeyError as error:
        raise TwinError(f"{path}: its graph has no {error.args[0]}; train it again") from error
    theta = np.concatenate([each.ravel() for each in rows])
    return TanhNetwork(card.network.units, card.network.inputs, UNSCALED, theta)


def _constants(graph: onnx.GraphProto) -> dict[str, Array]:
    """By name, also those of the graphs within its nodes."""
    found = {each.name: numpy_helper.to_array(each) for each in graph.initializer}
    for node in graph.node:
        for attribute in node.attribute:
            if attribute.type == onnx.AttributeProto.GRAPH:
                found |= _constants(attribute.g)
    return found


class OnnxTwin:
    """A loaded file. Raises TwinError, in one line, when it is missing, is not ONNX or is not a fantwin twin."""

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        if not self.path.is_file():
            raise TwinError(f"{self.path}: no such file; give the .onnx file of a twin")
        self._session = _session(self.path)
        metadata = self._session.get_modelmeta().custom_metadata_map
        if CARD_PROPERTY not in metadata:
            raise TwinError(
                f"{self.path}: an ONNX file without {CARD_PROPERTY}, so not a fantwin twin; make one with fantwin train"
            )
        try:
            self.card = TwinCard.from_json(metadata[CARD_PROPERTY])
        except CardError as error:
            raise TwinError(f"{self.path}: {error}") from error
        _require_fit(self.path, self._session, self.card)
        self.parameters = np.array(self.card.parameters, dtype=np.float64)

    @property
    def state_layout(self) -> StateLayout:
        """What the state holds."""
        return self.card.state_layout

    def steady_curve(self, parameters: Array) -> SteadyCurve | None:
        """See model.MayBeStatic."""
        return self.card.steady_curve(parameters)

    def advance(self, state: Array, command: Array, step_s: Array, parameters: Array) -> tuple[Array, Array]:
        """Free run over a block of samples; see model.TwinModel."""
        values = [np.ascontiguousarray(value, dtype=np.float64) for value in (state, command, step_s, parameters)]
        speed_rad_s, state_out = self._session.run(list(GRAPH_OUTPUTS), dict(zip(GRAPH_INPUTS, values, strict=True)))
        return np.asarray(speed_rad_s), np.asarray(state_out)


def _require_fit(path: Path, session: Any, card: TwinCard) -> None:
    """Raise TwinError unless the graph has the inputs and outputs that the card describes."""
    inputs, outputs = session.get_inputs(), session.get_outputs()
    names = tuple(value.name for value in inputs), tuple(value.name for value in outputs)
    if names != (GRAPH_INPUTS, GRAPH_OUTPUTS):
        raise TwinError(
            f"{path}: inputs {names[0]} and outputs {names[1]}; expected {GRAPH_INPUTS} and {GRAPH_OUTPUTS}"
        )
    if any(value.type != "tensor(double)" for value in (*inputs, *outputs)):
        raise TwinError(f"{path}: inputs and outputs must be float64; export the twin again")
    for name, width in (("state", card.n_state), ("parameters", len(card.parameter_names))):
        shape = inputs[GRAPH_INPUTS.index(name)].shape
        if len(shape) != 2 or shape[1] != width:
            raise TwinError(f"{path}: {name} is {shape}, the card says (fans, {width}); export the twin again")


def _session(path: Path) -> Any:
    os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")  # it sends as soon as it is imported, on Linux too since 1.31
    import onnxruntime  # noqa: PLC0415

    options = onnxruntime.SessionOptions()
    # Threads do not help with fifty tiny nodes: their overhead exceeds the work.
    options.intra_op_num_threads = 1
    options.inter_op_num_threads = 1
    options.log_severity_level = 3
    try:
        return onnxruntime.InferenceSession(path.read_bytes(), options, providers=["CPUExecutionProvider"])
    except Exception as error:
        # onnxruntime has a class of exception per status code and no common base of its own.
        reason = str(error).splitlines()[0]
        raise TwinError(
            f"{path}: not an ONNX file that can be run ({reason}); give the .onnx file of a twin"
        ) from error
