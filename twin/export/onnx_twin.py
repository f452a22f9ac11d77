"""An exported twin, run by onnxruntime like a model in memory, so that the file itself is evaluated."""

import os
from pathlib import Path
from typing import Any

import numpy as np

from fantwin.schemas.twin_card import CARD_PROPERTY, GRAPH_INPUTS, GRAPH_OUTPUTS, CardError, StateLayout, TwinCard
from fantwin.twin.errors import TwinError
from fantwin.twin.runs import Array


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
