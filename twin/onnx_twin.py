"""An exported twin, run by onnxruntime behind the interface of a model in memory: what ships is what is judged."""

import os
from pathlib import Path
from typing import Any

import numpy as np

from twin.card import CARD_KEY, Card
from twin.errors import TwinError
from twin.runs import Array
from twin.state import StateLayout

INPUTS = ["state", "command", "step_s", "parameters"]
OUTPUTS = ["speed_rad_s", "state_out"]


class OnnxTwin:
    """A loaded file. Raises TwinError, in one line, when it is missing, is not ONNX or is not a fantwin twin."""

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        if not self.path.is_file():
            raise TwinError(f"{self.path}: no such file; give the .onnx file of a twin")
        self._session = _session(self.path)
        metadata = self._session.get_modelmeta().custom_metadata_map
        if CARD_KEY not in metadata:
            raise TwinError(f"{self.path}: an ONNX file without {CARD_KEY}, so not a fantwin twin; export one first")
        try:
            self.card = Card.from_json(metadata[CARD_KEY])
        except TwinError as error:
            raise TwinError(f"{self.path}: {error}") from error
        inputs = [value.name for value in self._session.get_inputs()]
        outputs = [value.name for value in self._session.get_outputs()]
        if inputs != INPUTS or outputs != OUTPUTS:
            raise TwinError(f"{self.path}: inputs {inputs} and outputs {outputs}; expected {INPUTS} and {OUTPUTS}")
        if any(value.type != "tensor(double)" for value in (*self._session.get_inputs(), *self._session.get_outputs())):
            raise TwinError(f"{self.path}: inputs and outputs must be float64; export the twin again")
        self.parameters = np.array(self.card.parameters, dtype=np.float64)

    @property
    def state_layout(self) -> StateLayout:
        """What the state holds."""
        return self.card.state_layout

    def advance(self, state: Array, command: Array, step_s: Array, parameters: Array) -> tuple[Array, Array]:
        """Free run over a block of samples; see models.TwinModel."""
        values = [np.ascontiguousarray(value, dtype=np.float64) for value in (state, command, step_s, parameters)]
        speed_rad_s, state_out = self._session.run(OUTPUTS, dict(zip(INPUTS, values, strict=True)))
        return np.asarray(speed_rad_s), np.asarray(state_out)


def _session(path: Path) -> Any:
    os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")  # it sends as soon as it is imported, on Linux too since 1.31
    import onnxruntime  # noqa: PLC0415

    options = onnxruntime.SessionOptions()
    # A body of sixty tiny nodes gains nothing from threads, and their hand-over costs more than the work.
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
