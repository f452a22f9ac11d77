"""A twin as it is handed over: one ONNX file with its card inside.

The graph (float64) takes `state` (fans, n_state), `command` (n, fans), `step_s` (n,) and `parameters`
(fans, n_parameters), and gives `speed_rad_s` (n, fans), the speed at each sample before its command acts, and
`state_out` (fans, n_state). A continuous twin carries its speed and what is left of the commands before (the lagged
command), a discrete one as many past speeds and commands as its order. The metadata property `fantwin.card` holds the
card as JSON. docs/explanation/deciding.md tells how the card's healthy residual is used.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError, model_validator

from pipeline.runtime.stage import Context, StageError
from schemas.messages import Array
from scoring.diagnosis.regression_window import HealthyBalance

CARD_PROPERTY = "fantwin.card"
FORMAT_VERSION = 3
INPUTS = ("state", "command", "step_s", "parameters")
OUTPUTS = ("speed_rad_s", "state_out")
DEAD_ZONE = 0.25  # of the range of commands: a friction above so much of it is none

Range: TypeAlias = tuple[float, float]
Four: TypeAlias = tuple[float, float, float, float]
Advance: TypeAlias = Callable[[Array, Array, Array], tuple[Array, Array]]
"""(state (fans, n_state), command (n, fans), step_s (n,)) -> (speed_rad_s (n, fans), state (fans, n_state))."""


class _OfCard(BaseModel):
    model_config = ConfigDict(frozen=True, extra="allow", allow_inf_nan=False)


class StateLayout(_OfCard):
    """A state is `speed` past speeds and then `command` past commands, newest first."""

    speed: int = Field(ge=1)
    command: int = Field(ge=0)


class BalanceCard(_OfCard):
    """The torque balance, one entry a fan; see Balance."""

    inertia: tuple[Annotated[float, Field(ge=0)], ...]
    viscous: tuple[float, ...]
    drag: tuple[float, ...]
    friction: tuple[float, ...]
    covariance: tuple[tuple[Four, Four, Four, Four], ...]
    lag_s: tuple[Annotated[float, Field(ge=0)], ...]
    sigma_command: tuple[Annotated[float, Field(gt=0)], ...]
    autocorrelation_time_s: tuple[Annotated[float, Field(gt=0)], ...]
    lowest_speed_rad_s: tuple[Annotated[float, Field(ge=0)], ...]
    filter_rate_per_s: float = Field(gt=0)

    @model_validator(mode="before")
    @classmethod
    def _of_older_card(cls, card: Any) -> Any:
        """Cards once had the errors one by one; how they go together is not known of those."""
        if isinstance(card, dict) and card.get("covariance") is None and "std_errors" in card:
            try:
                errors = TypeAdapter(tuple[Four, ...]).validate_python(card["std_errors"])
            except ValidationError as error:
                raise ValueError("std_errors must have four numbers for each fan") from error
            return card | {"covariance": [np.diag(np.square(of_fan)).tolist() for of_fan in errors]}
        return card

    @model_validator(mode="after")
    def _covariance_is_one(self) -> BalanceCard:
        for matrix in map(np.array, self.covariance):
            if not np.allclose(matrix, matrix.T) or matrix.diagonal().min() < 0.0:
                raise ValueError("covariance must be symmetric, with no variance below zero")
        return self

    @property
    def of_fans(self) -> dict[str, tuple[Any, ...]]:
        """What has one entry a fan, by its name."""
        return {name: getattr(self, name) for name in BalanceCard.model_fields if name != "filter_rate_per_s"}


class TwinCard(_OfCard):
    """What the stages need of the card; it holds more, for people."""

    format_version: int
    name: str
    kind: Literal["physical", "narx", "neural-ode", "hybrid"]
    fans: int = Field(ge=1)
    n_state: int = Field(ge=1)
    state_layout: StateLayout
    parameters: tuple[tuple[float, ...], ...]
    sigma_rad_s: tuple[Annotated[float, Field(gt=0)], ...]
    balance: BalanceCard
    calibration: dict[str, Any] | None = None
    command_range: Range
    rate_hz: float = Field(gt=0)

    @model_validator(mode="after")
    def _consistent(self) -> TwinCard:
        if self.state_layout.speed + self.state_layout.command != self.n_state:
            raise ValueError("state_layout does not add up to n_state")
        if len(self.parameters) != self.fans or len({len(row) for row in self.parameters}) != 1:
            raise ValueError("parameters must have one row of equal length for each fan")
        if len(self.sigma_rad_s) != self.fans:
            raise ValueError("sigma_rad_s must have one value for each fan")
        for name, values in self.balance.of_fans.items():
            if len(values) != self.fans:
                raise ValueError(f"balance.{name} must have one value for each fan")
        if not self.command_range[0] < self.command_range[1]:
            raise ValueError("command_range must rise")
        return self


@dataclass(frozen=True)
class Balance:
    """The torque balance of each fan: what it needs, and how far a healthy one strays from it within a run.

    needed command = inertia w' + viscous w + drag w|w| + friction, with a constant friction, and both sides through
    lambda / (s + lambda). Units are those of the command with rad/s and s. covariance: (fans, 4, 4) of the errors of
    these four. The others are (fans,), but for lambda.
    """

    inertia: Array
    viscous: Array
    drag: Array
    friction: Array
    covariance: Array
    lag_s: Array
    """of the command before it acts"""
    sigma_command: Array
    """healthy standard deviation of the balance within a run"""
    autocorrelation_time_s: Array
    """of the healthy balance"""
    lowest_speed_rad_s: Array
    """below it the balance means nothing"""
    filter_rate_per_s: float
    """lambda"""


@dataclass(frozen=True)
class TwinFile:
    """A twin ready to run for a tray. `advance` carries the state over a block of samples; it keeps nothing."""

    name: str
    kind: str
    sha256: str
    card_json: str
    layout: StateLayout
    sigma_rad_s: Array
    """(fans,) standard deviation of the healthy residual"""
    balance: Balance
    calibration: dict[str, Any] | None
    """of the alarms, as the card has it; None where they were never calibrated"""
    command_range: Range
    rate_hz: float
    """rate of the data it was made from"""
    advance: Advance

    @property
    def fans(self) -> int:
        """How many fans it runs for."""
        return len(self.sigma_rad_s)

    @property
    def is_discrete(self) -> bool:
        """Whether it steps from sample to sample and so holds at its own rate only."""
        return self.kind == "narx"

    @property
    def top_speed_rad_s(self) -> float:
        """The highest it was made from; infinite where its card does not say."""
        return max(map(abs, json.loads(self.card_json).get("speed_range_rad_s", (np.inf,))))

    @property
    def command_unit(self) -> str:
        """Of the balance; empty where the card does not say."""
        return str(json.loads(self.card_json).get("command_unit", ""))

    @property
    def off_below(self) -> Array:
        """(fans,) the smallest command that turns the rotor: the friction, unless it lies amidst the healthy commands.

        Then the fan was held at one speed, where friction takes the place of a drag that could not be told.
        """
        low, high = self.command_range
        friction = self.balance.friction
        return np.where((friction > 0.0) & (friction < low + DEAD_ZONE * (high - low)), friction, -np.inf)

    @property
    def bend_rad_s(self) -> float | None:
        """Where drag and viscous part each make half of what a little more speed needs; None without either."""
        of = self.balance
        if not np.all((of.viscous > 0.0) & (of.drag > 0.0)):
            return None
        return float(np.median(of.viscous / (2.0 * of.drag)))

    def healthy_balances(self) -> list[HealthyBalance]:
        """The balance fan by fan, as those that judge want it."""
        of, rate_per_s = self.balance, self.balance.filter_rate_per_s
        return [
            HealthyBalance(
                inertia=float(of.inertia[fan]),
                viscous=float(of.viscous[fan]),
                drag=float(of.drag[fan]),
                friction=float(of.friction[fan]),
                lag_s=float(of.lag_s[fan]),
                covariance=of.covariance[fan],
                filter_rate_per_s=rate_per_s,
                sigma_command=float(of.sigma_command[fan]),
                autocorrelation_time_s=float(of.autocorrelation_time_s[fan]),
                lowest_speed_rad_s=float(of.lowest_speed_rad_s[fan]),
            )
            for fan in range(self.fans)
        ]

    def initial_state(self, speed_rad_s: Array, command: Array) -> Array:
        """(fans, n_state) of fans that have long run at speed_rad_s (fans,) under command (fans,)."""
        return np.column_stack([speed_rad_s] * self.layout.speed + [command] * self.layout.command)

    @classmethod
    def load(cls, path: Path, fans: int | None = None) -> TwinFile:
        """Load a twin for a tray of `fans` fans; without it, of as many as it has. One fan's twin serves every fan.

        Raises:
            StageError: the file is missing, not ONNX, not a twin, from another fantwin, or for other fans.
        """
        try:
            content = path.read_bytes()
        except OSError as error:
            raise StageError(f"{path}: cannot read the twin: {error.strerror}; correct [[tray]] twin") from error
        session = _session(path, content)
        card_json = session.get_modelmeta().custom_metadata_map.get(CARD_PROPERTY)
        if card_json is None:
            raise StageError(
                f"{path}: an ONNX file, but not a twin: it has no {CARD_PROPERTY}; make one: fantwin train"
            )
        card = _card(path, card_json)
        fans = fans or card.fans
        if card.fans not in (1, fans):
            raise StageError(
                f"{path}: a twin of {card.fans} fans, [[tray]] says fans = {fans}: choose a twin that fits"
            )
        _check_graph(path, session, card)
        parameters = _for_fans(card.parameters, fans)
        twin = cls(
            name=card.name,
            kind=card.kind,
            sha256=hashlib.sha256(content).hexdigest(),
            card_json=card_json,
            layout=card.state_layout,
            sigma_rad_s=_for_fans(card.sigma_rad_s, fans),
            balance=Balance(
                **{name: _for_fans(values, fans) for name, values in card.balance.of_fans.items()},
                filter_rate_per_s=card.balance.filter_rate_per_s,
            ),
            calibration=card.calibration,
            command_range=card.command_range,
            rate_hz=card.rate_hz,
            advance=_advance(session, parameters),
        )
        _check_run(path, twin)
        return twin


def _for_fans(values: tuple[Any, ...], fans: int) -> Array:
    """(fans, ...) values of each fan; those of a twin of one fan hold for all."""
    of_card = np.array(values, dtype=np.float64)
    return np.broadcast_to(of_card, (fans, *of_card.shape[1:])).copy()


def _session(path: Path, content: bytes) -> Any:
    os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")  # it sends as soon as it is imported, on Linux too since 1.31
    # Imported here, so that stages that run no twin start without it.
    import onnxruntime  # noqa: PLC0415

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1  # the graph is small; more threads only wait for one another
    options.inter_op_num_threads = 1
    options.log_severity_level = 3
    try:
        return onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # its exceptions have no common base of their own
        raise StageError(f"{path}: not an ONNX file that can be run: {_first_line(error)}") from error


def _first_line(error: Exception) -> str:
    return str(error).splitlines()[0]


def _card(path: Path, card_json: str) -> TwinCard:
    try:
        version = _Version.model_validate_json(card_json).format_version
        if version != FORMAT_VERSION:
            what = "update fantwin" if version > FORMAT_VERSION else "train it anew"
            raise StageError(f"{path}: twin format {version}, this fantwin knows {FORMAT_VERSION}: {what}")
        return TwinCard.model_validate_json(card_json)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"])) or "it"
        raise StageError(f"{path}: the twin's card cannot be used: {where}: {first['msg']}; train it anew") from error


class _Version(_OfCard):
    """What a card of any format has."""

    format_version: int


def _check_graph(path: Path, session: Any, card: TwinCard) -> None:
    inputs = {node.name: node for node in session.get_inputs()}
    outputs = {node.name: node for node in session.get_outputs()}
    if set(inputs) != set(INPUTS) or not set(OUTPUTS) <= set(outputs):
        raise StageError(
            f"{path}: not a twin's graph: it has inputs {', '.join(inputs)} and outputs {', '.join(outputs)}; "
            f"needed are {', '.join(INPUTS)} and {', '.join(OUTPUTS)}"
        )
    for name, node in (inputs | {name: outputs[name] for name in OUTPUTS}).items():
        if node.type != "tensor(double)":
            raise StageError(f"{path}: {name} is {node.type}, needed is tensor(double); export it anew")
    for name, width in (("state", card.n_state), ("parameters", len(card.parameters[0]))):
        shape = inputs[name].shape
        if len(shape) != 2 or (isinstance(shape[1], int) and shape[1] != width):
            raise StageError(
                f"{path}: graph and card disagree: {name} is {shape}, the card says (fans, {width}); export it anew"
            )


def _check_run(path: Path, twin: TwinFile) -> None:
    """Two samples at rest: what neither the card nor the names of the inputs tell shows here, not while fans run."""
    command = np.full((2, twin.fans), twin.command_range[0])
    state = twin.initial_state(np.zeros(twin.fans), command[0])
    try:
        speed_rad_s, state_out = twin.advance(state, command, np.full(2, 1.0 / twin.rate_hz))
    except Exception as error:  # as in _session
        raise StageError(f"{path}: the twin does not run: {_first_line(error)}; export it anew") from error
    if speed_rad_s.shape != command.shape or state_out.shape != state.shape:
        raise StageError(
            f"{path}: the twin gives speeds {speed_rad_s.shape} and state {state_out.shape}, "
            f"needed are {command.shape} and {state.shape}; export it anew"
        )


def _advance(session: Any, parameters: Array) -> Advance:
    def advance(state: Array, command: Array, step_s: Array) -> tuple[Array, Array]:
        feed = {"state": state, "command": command, "step_s": step_s, "parameters": parameters}
        speed_rad_s, state_out = session.run(list(OUTPUTS), feed)
        return speed_rad_s, state_out

    return advance


def twin_of(context: Context) -> TwinFile:
    """The twin of a context's one tray.

    Raises:
        StageError: the tray names none, or one that cannot be used.
    """
    tray = context.tray
    if tray.twin is None:
        raise StageError(f'tray {tray.name} has no twin: set [[tray]] twin = "FILE.onnx"')
    return TwinFile.load(context.resolve(tray.twin), tray.fans)
