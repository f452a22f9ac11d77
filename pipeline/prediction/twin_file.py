"""A twin ready to run: its card (pipeline.prediction.tray_twin) and its graph in onnxruntime.

schemas/twin_card.py describes card and graph. The graph is checked before it runs, so that an unusable file is refused
when the stage starts, not while fans run.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from fantwin.pipeline.config.settings import TrayConfig
from fantwin.pipeline.prediction.tray_twin import TrayTwin, for_fans, read_file, tray_twin, twin_path
from fantwin.pipeline.runtime.stage import Context, StageError
from fantwin.schemas.messages import Array
from fantwin.schemas.tacho import Tacho, tacho_of_each_fan
from fantwin.schemas.twin_card import GRAPH_INPUTS, GRAPH_OUTPUTS, TwinCard

Advance: TypeAlias = Callable[[Array, Array, Array], tuple[Array, Array]]
"""(state (fans, n_state), command (n, fans), step_s (n,)) -> (speed_rad_s (n, fans), state (fans, n_state))."""
FIRST_RUN_LIMIT_S = 10.0
"""limit on the time of the two samples that are run at load; they take about a millisecond"""


@dataclass(frozen=True)
class TwinFile(TrayTwin):
    """A twin ready to run for a tray.

    advance_with: how to run it with some parameters. parameters: (fans, n_parameters) those of the fans.
    """

    advance_with: Callable[[Array], Advance]
    parameters: Array

    @cached_property
    def advance(self) -> Advance:
        """Runs a block of samples from a state; it keeps nothing itself."""
        return self.advance_with(self.parameters)

    def of_trays(self, count: int) -> TwinFile:
        """Twin for the fans of `count` trays."""
        rows = [*range(self.fans)] * count
        return replace(
            self,
            sigma_rad_s=self.sigma_rad_s[rows],
            balance=self.balance.of_fans(rows),
            tachos=self.tachos * count,
            drive=self.drive and self.drive.of_fans(rows),
            parameters=self.parameters[rows],
        )

    def initial_state(self, speed_rad_s: Array, command: Array) -> Array:
        """State (fans, n_state) of fans that have run for long at speed_rad_s (fans,) under command (fans,)."""
        return self.card.state_layout.initial_state(speed_rad_s, command)

    @classmethod
    def load(cls, path: Path, fans: int | None = None) -> TwinFile:
        """Load a twin for a tray of `fans` fans; without it, of as many as it has. A twin of one fan serves every fan.

        Raises:
            StageError: the file is missing, not ONNX, not a twin, from another fantwin, or for other fans.
        """
        return cls.of_content(path, read_file(path), fans)

    @classmethod
    def of_content(cls, path: Path, content: bytes, fans: int | None = None) -> TwinFile:
        """The twin in the content of a file. path: its name, for errors.

        Raises:
            StageError: as `load`.
        """
        session = _session(path, content)
        known = tray_twin(path, content, fans)
        _check_graph(path, session, known.card)
        parameters = for_fans(known.card.parameters, known.fans)

        def twin(options: Any = None) -> TwinFile:
            def advance_with(parameters: Array) -> Advance:
                return _advance(session, parameters, options)

            return cls(**vars(known), advance_with=advance_with, parameters=parameters)

        with _time_limit(FIRST_RUN_LIMIT_S) as options:
            _check_run(path, twin(options), options)
        return twin()


def load_twin(context: Context) -> TwinFile:
    """The twin of a context's one tray, ready to run.

    Raises:
        StageError: the tray names none, or one that cannot be used or was trained with other tachos or fans.
    """
    path = twin_path(context.tray, context.folder)
    return _of_tray(context.tray, path, TwinFile.load(path, context.tray.fans))


def learned_twin(tray: TrayConfig, name: str, content: bytes) -> TwinFile:
    """A learned twin, ready to run for its tray. content: of its file.

    Raises:
        StageError: it cannot be used.
    """
    path = Path(name)
    return _of_tray(tray, path, TwinFile.of_content(path, content, tray.fans))


def _of_tray(tray: TrayConfig, path: Path, twin: TwinFile) -> TwinFile:
    """The same twin. Raises StageError if it was trained with other tachos, or on fans in another order."""
    if mistake := twin.card.other_order(tray.names.names):
        raise StageError(f"{path}: tray {tray.name}: {mistake}")
    of_tray = tacho_of_each_fan(tray.tachos, tray.fans)
    if twin.tachos != of_tray and any(tacho.window_s > 0.0 for tacho in twin.tachos):
        raise StageError(
            f"{path}: the twin was trained on readings by {_text(twin.tachos)}, but those of the tray are by "
            f"{_text(of_tray)}: correct tacho (of a table: import it again with --tacho), or train a twin on "
            "recordings of this tray"
        )
    return twin


def _text(tachos: Sequence[Tacho]) -> str:
    """Each different tacho once."""
    return ", ".join(dict.fromkeys(map(str, tachos)))


def _session(path: Path, content: bytes) -> Any:
    os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")  # it sends as soon as it is imported, on Linux too since 1.31
    # Imported here, so that commands that run no twin start without it.
    import onnxruntime  # noqa: PLC0415

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1  # the graph is small: more threads only wait for one another
    options.inter_op_num_threads = 1
    options.log_severity_level = 3
    try:
        return onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # its exceptions have no common base of their own
        raise StageError(f"{path}: not an ONNX file that can be run: {_first_line(error)}") from error


def _first_line(error: Exception) -> str:
    return str(error).splitlines()[0]


def _check_graph(path: Path, session: Any, card: TwinCard) -> None:
    inputs = {node.name: node for node in session.get_inputs()}
    outputs = {node.name: node for node in session.get_outputs()}
    if set(inputs) != set(GRAPH_INPUTS) or not set(GRAPH_OUTPUTS) <= set(outputs):
        raise StageError(
            f"{path}: not a twin's graph: it has inputs {', '.join(inputs)} and outputs {', '.join(outputs)}; "
            f"expected {', '.join(GRAPH_INPUTS)} and {', '.join(GRAPH_OUTPUTS)}"
        )
    for name, node in (inputs | {name: outputs[name] for name in GRAPH_OUTPUTS}).items():
        if node.type != "tensor(double)":
            raise StageError(f"{path}: {name} is {node.type}, expected tensor(double); export it again")
    for name, width in (("state", card.n_state), ("parameters", len(card.parameter_names))):
        shape = inputs[name].shape
        if len(shape) != 2 or (isinstance(shape[1], int) and shape[1] != width):
            raise StageError(
                f"{path}: graph and card disagree: {name} is {shape}, the card says (fans, {width}); export it again"
            )


@contextmanager
def _time_limit(limit_s: float) -> Iterator[Any]:
    """Options of a run that onnxruntime ends after `limit_s`, even inside a loop of the graph."""
    import onnxruntime  # noqa: PLC0415  as in _session

    options = onnxruntime.RunOptions()
    timer = threading.Timer(limit_s, setattr, (options, "terminate", True))
    timer.daemon = True
    timer.start()
    try:
        yield options
    finally:
        timer.cancel()


def _check_run(path: Path, twin: TwinFile, options: Any) -> None:
    """Run two samples at rest: this finds what neither the card nor the names and types of the graph show."""
    command = np.full((2, twin.fans), twin.card.command_range[0])
    state = twin.initial_state(np.zeros(twin.fans), command[0])
    try:
        speed_rad_s, state_out = twin.advance(state, command, np.full(2, 1.0 / twin.card.rate_hz))
    except Exception as error:  # as in _session
        if options.terminate:
            raise StageError(
                f"{path}: the twin takes more than {FIRST_RUN_LIMIT_S:g} s for two samples; export it again"
            ) from error
        raise StageError(f"{path}: the twin does not run: {_first_line(error)}; export it again") from error
    if speed_rad_s.shape != command.shape or state_out.shape != state.shape:
        raise StageError(
            f"{path}: the twin gives speeds {speed_rad_s.shape} and state {state_out.shape}, "
            f"expected {command.shape} and {state.shape}; export it again"
        )


def _advance(session: Any, parameters: Array, options: Any = None) -> Advance:
    def advance(state: Array, command: Array, period_s: Array) -> tuple[Array, Array]:
        feed = {"state": state, "command": command, "step_s": period_s, "parameters": parameters}
        speed_rad_s, state_out = session.run(list(GRAPH_OUTPUTS), feed, options)
        return speed_rad_s, state_out

    return advance
