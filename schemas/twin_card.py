"""The twin card: what a twin is and how good it is, as JSON inside its ONNX file (metadata property `fantwin.card`).

The model maker writes it. The runtime, the reports and the viewer read it. This is its only definition.

The graph beside it (float64) takes `state` (fans, n_state), `command` (n, fans), `step_s` (n,) and `parameters`
(fans, n_parameters). It returns `speed_rad_s` (n, fans), the speed at each sample before its command acts, and
`state_out` (fans, n_state).
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated, Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field, TypeAdapter, ValidationError, model_validator
from pydantic.dataclasses import dataclass

from fantwin.schemas.formats import TWIN_CARD
from fantwin.schemas.model_uncertainty import ModelUncertainty
from fantwin.schemas.reference_conditions import ReferenceConditions
from fantwin.schemas.standstill import Standstill
from fantwin.schemas.steady_curve import SteadyCurve
from fantwin.schemas.tacho import INSTANTANEOUS, Tacho, Tachos, tacho_of_each_fan
from fantwin.schemas.units import RAD_S_PER_UNIT, period_in_words

CARD_PROPERTY = "fantwin.card"
GRAPH_INPUTS = ("state", "command", "step_s", "parameters")
GRAPH_OUTPUTS = ("speed_rad_s", "state_out")
STATIC_PARAMETERS = ("time_constant_s", "unknown_time")
"""first parameters of a twin of the speed over the command (twin.models.static), whose samples hardly show motion"""

NOT_CALIBRATED = (
    "is not calibrated: its alarms are by the priors of a population of fans, 0.03 false alarms per fan and day"
)
AS_DECLARED, LOOSER = 1.1, 1.5
"""limits of the free-run rmse in healthy sigma: a twin follows as declared up to the first, looser up to the second"""

Array: TypeAlias = NDArray[np.float64]
Positive: TypeAlias = Annotated[float, Field(gt=0)]
NotNegative: TypeAlias = Annotated[float, Field(ge=0)]
Count: TypeAlias = Annotated[int, Field(ge=1)]
Range: TypeAlias = tuple[float, float]
Four: TypeAlias = tuple[float, float, float, float]
BalanceSource: TypeAlias = Literal["physics", "least-squares"]

# Unknown fields are ignored: a later program may add some without a new format.
_CONFIG = ConfigDict(extra="ignore", allow_inf_nan=False)


class CardError(ValueError):
    """Text that is not a card, or a card of another format. One line that says what to do."""


@dataclass(frozen=True, config=_CONFIG)
class StateLayout:
    """A state holds, for each fan, `speed` past speeds and then `command` past commands, newest first.

    A model that is continuous in time has one of each: its speed and the lagged command. The command part follows from
    the commands alone, whatever the speeds are.
    """

    speed: Count
    command: Annotated[int, Field(ge=0)]

    @property
    def size(self) -> int:
        """Numbers of state per fan."""
        return self.speed + self.command

    def initial_state(self, speed_rad_s: Array, command: Array) -> Array:
        """(fans, size) state of fans that have run for long at speed_rad_s (fans,) under command (fans,)."""
        return np.column_stack([speed_rad_s] * self.speed + [command] * self.command)


@dataclass(frozen=True, config=_CONFIG)
class NetworkCard:
    """The network; zero units without one. parameter_count: its trained weights; physics do not count."""

    units: int
    inputs: tuple[str, ...]
    parameter_count: int


@dataclass(frozen=True, config=_CONFIG)
class DataCard:
    """One file of data. first_s, last_s: the part that was used, since its first sample; None: perhaps all of it."""

    name: str
    sha256: str
    fans: int
    samples: int
    first_s: float | None = None
    last_s: float | None = None

    def overlaps(self, other: DataCard) -> bool:
        """Whether both have samples in common."""
        if self.sha256 != other.sha256:
            return False
        return all(
            one.first_s is None or two.last_s is None or one.first_s <= two.last_s
            for one, two in ((self, other), (other, self))
        )


@dataclass(frozen=True, config=_CONFIG)
class TrainingCard:
    """How the twin was trained.

    physics: whether they were refined together with the network. duration_s: duration of the training. fans: the fan
    numbers in the recordings, in the order of the card's lists; empty: counted from 0. fan_names: what the recordings
    call them, each empty where it has none; empty: none has one. networks: how many were trained; the twin is the mean
    of those that ended about as well as the best. iterations: of all of them. of_type: name of the twin of the type
    whose network it has, if only its physics are of these fans; else empty.
    """

    trainer: str
    physics: Literal["fixed", "refined"]
    seed: int
    iterations: int
    duration_s: float
    data: tuple[DataCard, ...]
    fans: tuple[int, ...] = ()
    networks: Count = 1
    of_type: str = ""
    fan_names: tuple[str, ...] = ()


@dataclass(frozen=True, config=_CONFIG)
class ValidationCard:
    """Free-run errors pooled over fans, in rad/s. None where a figure is undefined.

    source: whether the runs were held out or are the training runs themselves. data: the held-out files.
    """

    source: Literal["held-out", "training"]
    data: tuple[DataCard, ...]
    samples: int
    rmse: float | None
    max_error: float | None
    r2: float | None
    one_step_rmse: float | None
    coverage_2_sigma: float | None


@dataclass(frozen=True, config=_CONFIG)
class HealthyCard:
    """The healthy free-run residual, one entry a fan; None where the runs were too short to estimate it.

    autocorrelation_time_s, independent_samples: as in twin.evaluation.residual_analysis. quantiles_sigma: magnitudes,
    in sigma, that a healthy sample stays below with the given probabilities. max_sigma: the largest magnitude seen.
    """

    autocorrelation_time_s: tuple[float | None, ...]
    independent_samples: tuple[float | None, ...]
    probabilities: tuple[float, ...]
    quantiles_sigma: tuple[tuple[float | None, ...], ...]
    max_sigma: tuple[float | None, ...]


@dataclass(frozen=True, config=_CONFIG)
class BalanceCard:
    """The torque balance, one entry a fan, in units of the command with rad/s and s.

    needed command = inertia w' + viscous w + drag w|w| + friction, with a constant friction, and both sides filtered
    by lambda / (s + lambda). lambda is filter_rate_per_s. lag_s: lag of the command before it acts. covariance: of the
    errors of the four coefficients. source: how the coefficients were found (twin.fitting.balance_fit). sigma_command
    and autocorrelation_time_s: standard deviation and autocorrelation time of the healthy balance within a run.
    lowest_speed_rad_s: the balance does not hold below this speed.
    """

    inertia: tuple[NotNegative, ...]
    viscous: tuple[float, ...]
    drag: tuple[float, ...]
    friction: tuple[float, ...]
    covariance: tuple[tuple[Four, Four, Four, Four], ...]
    lag_s: tuple[NotNegative, ...]
    source: tuple[BalanceSource, ...]
    sigma_command: tuple[Positive, ...]
    autocorrelation_time_s: tuple[Positive, ...]
    lowest_speed_rad_s: tuple[NotNegative, ...]
    filter_rate_per_s: Positive

    @model_validator(mode="after")
    def _check_covariance(self) -> BalanceCard:
        for matrix in map(np.array, self.covariance):
            if not np.allclose(matrix, matrix.T) or matrix.diagonal().min() < 0.0:
                raise ValueError("covariance must be symmetric, with no variance below zero")
        return self

    @property
    def per_fan(self) -> dict[str, tuple[Any, ...]]:
        """The fields with one entry a fan, by name."""
        return {name: value for name, value in vars(self).items() if isinstance(value, tuple)}


@dataclass(frozen=True, config=_CONFIG)
class DriveCard:
    """What the drives of fans that control their own speed make of the command. The graph contains it.

    turning_command: a smaller one stops the fans. kick_s: how long the kick of a start lasts, after rest_s without
    drive. lowest_command: for each fan; a smaller command that turns it acts as this one. The friction and the kick of
    each fan are among the card's parameters.
    """

    turning_command: Positive
    kick_s: Positive
    rest_s: Positive
    lowest_command: tuple[NotNegative, ...]

    def of_fans(self, rows: Sequence[int]) -> DriveCard:
        """That of the fans in these rows; a single one for all fans is returned as it is."""
        if len(self.lowest_command) == 1:
            return self
        return replace(self, lowest_command=tuple(self.lowest_command[row] for row in rows))

    def raised(self, command: Array) -> Array:
        """(n, fans) the commands with those on the plateau raised to its end; the torque balance is taken with them.

        NaN stays NaN.
        """
        raised = np.maximum(command, np.array(self.lowest_command))
        return np.where(command >= self.turning_command, raised, command)


@dataclass(frozen=True, config=_CONFIG)
class TwinCard:
    """Everything a reader of the file needs to know. Lists per fan are in the order of the fans.

    kind: name of the kind of model, for people; programs ask the other fields. fixed_rate: whether the model holds at
    rate_hz only. parameters: those in force, per fan, in the order of parameter_names; used_parameters:
    the names of those that the model uses. identified_parameters,
    parameter_interval_95: of the physical model alone; a hybrid's parameters in force differ
    where its network has taken a share. sigma_rad_s: per fan, the healthy root mean square free-run error.
    speed_range_rad_s, command_range, rate_hz: of the training data; outside them the twin extrapolates. calibration:
    of the alarms (scoring.calibration), None before calibration. tacho: what the free run must pass before it is
    compared with readings, and the command before the torque balance; one for all fans, or one for each. standstill:
    how the fans stop, stand and start; None where the runs do not show at which commands fans turn. drive:
    of fans that control their own speed; None: the command acts as it is. reading_sigma_rad_s: per fan, root mean
    square of the distance of healthy readings from those that the tachos may show of the free run, of fans that neither
    start nor stand; empty where tachos are instantaneous: it is sigma_rad_s there.
    model_uncertainty: how far the twin itself may be wrong at each speed and command, for each fan; of hybrids only,
    None for other kinds. conditions: the supply voltage and the air for which it holds, and so the
    columns that it needs beside the command (schemas.reference_conditions); None: none. steady_commands: those at which
    the parameters of a static twin are speeds; empty: it is none. closed_loop: for each fan, whether its command
    answered its measured speed in training or calibration; empty: not known. format: of the card.
    """

    kind: str
    name: str
    created: str
    fans: Count
    n_state: Count
    state_layout: StateLayout
    fixed_rate: bool
    parameter_names: tuple[str, ...]
    used_parameters: tuple[str, ...]
    parameters: tuple[tuple[float, ...], ...]
    identified_parameters: tuple[tuple[float, ...], ...]
    parameter_interval_95: tuple[tuple[Range, ...], ...]
    sigma_rad_s: tuple[Positive, ...]
    healthy: HealthyCard
    balance: BalanceCard
    speed_range_rad_s: Range
    command_range: Range
    rate_hz: Positive
    network: NetworkCard
    training: TrainingCard
    validation: ValidationCard
    versions: dict[str, str]
    command_unit: str
    speed_unit: Literal["rad/s"] = "rad/s"
    calibration: dict[str, Any] | None = None
    tacho: Tachos = INSTANTANEOUS
    standstill: Standstill | None = None
    drive: DriveCard | None = None
    reading_sigma_rad_s: tuple[Positive, ...] = ()
    model_uncertainty: ModelUncertainty | None = None
    conditions: ReferenceConditions | None = None
    steady_commands: tuple[float, ...] = ()
    closed_loop: tuple[bool, ...] = ()
    format: int = TWIN_CARD.written

    @model_validator(mode="after")
    def _check_consistency(self) -> TwinCard:
        if self.state_layout.size != self.n_state:
            raise ValueError("state_layout does not add up to n_state")
        if [len(row) for row in self.parameters] != [len(self.parameter_names)] * self.fans:
            raise ValueError("parameters must have one row for each fan, as long as parameter_names")
        if len(self.sigma_rad_s) != self.fans:
            raise ValueError("sigma_rad_s must have one value for each fan")
        if len(self.reading_sigma_rad_s) not in (0, self.fans):
            raise ValueError("reading_sigma_rad_s must have one value for each fan, or none")
        for name, values in self.balance.per_fan.items():
            if len(values) != self.fans:
                raise ValueError(f"balance.{name} must have one value for each fan")
        if len(self.fan_numbers) != self.fans:
            raise ValueError("training.fans must name each fan, or none")
        if len(self.training.fan_names) not in (0, self.fans):
            raise ValueError("training.fan_names must have one name for each fan, or none")
        if len(self.closed_loop) not in (0, self.fans):
            raise ValueError("closed_loop must have one value for each fan, or none")
        tacho_of_each_fan(self.tacho, self.fans)
        if self.drive is not None and len(self.drive.lowest_command) != self.fans:
            raise ValueError("drive.lowest_command must have one value for each fan")
        if self.model_uncertainty is not None and len(self.model_uncertainty.std_rad_s) not in (1, self.fans):
            raise ValueError("model_uncertainty.std_rad_s must have one table for each fan, or one for all")
        if not self.command_range[0] < self.command_range[1]:
            raise ValueError("command_range must be in ascending order")
        return self

    def __str__(self) -> str:
        """The most important in a few lines, with speeds in rpm."""
        of, rpm = self.validation, RAD_S_PER_UNIT["rpm"]
        figures = {"rmse_rpm": of.rmse, "max_error_rpm": of.max_error}
        shown = {name: value / rpm for name, value in figures.items() if value is not None}
        shown |= {"sigma_rpm": max(self.sigma_rad_s) / rpm} | ({} if of.r2 is None else {"r2": of.r2})
        fans = f"{self.fans} fan{'s' * (self.fans != 1)}"
        fans += f" ({', '.join(self.training.fan_names)})" if self.training.fan_names else ""
        low, high = (speed / rpm for speed in self.speed_range_rad_s)
        return "\n".join(
            (
                f"{self.name}: {self.kind} twin of {fans}, "
                + (
                    f"samples every {period_in_words(1.0 / self.rate_hz)}"
                    if self.is_static
                    else f"{self.rate_hz:.3g} Hz"
                ),
                f"trained on {sum(each.samples for each in self.training.data)} samples, {self.created}",
                f"command {self.command_range[0]:.4g} to {self.command_range[1]:.4g} {self.command_unit}".rstrip()
                + f", speed_rpm {low:.4g} to {high:.4g}",
                f"{of.source} free run: " + ", ".join(f"{name} {value:.4g}" for name, value in shown.items()),
                *(["closed loop: yes"] if any(self.closed_loop) else []),
            )
        )

    def other_order(self, names: Sequence[str], rows: Sequence[int] | None = None) -> str:
        """What is wrong with fans that the twin knows in other places, as fans are matched by number; empty: nothing.

        names: of the fans, each empty where it has none. rows: the place of each in the card's lists; without it, the
        same place.
        """
        own = self.training.fan_names
        found = [
            (name, own[row])
            for name, row in zip(names, rows or range(len(own)), strict=False)
            if name in own and own[row] and own[row] != name
        ]
        if not found:
            return ""
        here, there = (", ".join(each) for each in zip(*found, strict=True))
        return f"the fans {here} are in the places of {there} in the twin: use a twin of these fans in this order"

    @property
    def fan_numbers(self) -> tuple[int, ...]:
        """Numbers of the fans in the recordings; counted from 0 where the card does not say."""
        return self.training.fans or tuple(range(self.fans))

    @property
    def title(self) -> str:
        """Its kind, for people."""
        return f"{self.kind}, samples every {period_in_words(1.0 / self.rate_hz)}" if self.is_static else self.kind

    @property
    def is_static(self) -> bool:
        """Whether it is the speed over the command alone: samples were too far apart to show the motion."""
        return len(self.steady_commands) > 0

    def steady_curve(self, parameters: Array) -> SteadyCurve | None:
        """The curve of fans with these parameters, (fans, n); None where the twin is not static."""
        speeds = parameters[:, len(STATIC_PARAMETERS) :]
        return SteadyCurve(np.array(self.steady_commands), speeds, parameters[:, 0]) if self.is_static else None

    @property
    def tacho_of_each_fan(self) -> tuple[Tacho, ...]:
        """(fans,) tachos."""
        return tacho_of_each_fan(self.tacho, self.fans)

    @property
    def top_speed_rad_s(self) -> float:
        """The highest speed in the training data, in either direction."""
        return max(map(abs, self.speed_range_rad_s))

    def to_json(self) -> str:
        """One line of JSON."""
        return json.dumps(_CARD.dump_python(self), allow_nan=False)

    @staticmethod
    def from_json(text: str) -> TwinCard:
        """The card in JSON text.

        Raises:
            CardError: it is not a card, or of an unknown format.
        """
        try:
            fields = json.loads(text)
        except json.JSONDecodeError as error:
            raise CardError(f"the twin's card cannot be used: it is not JSON ({error}); train it again") from error
        stated = fields.get("format") if isinstance(fields, dict) else None
        if refusal := TWIN_CARD.refusal(stated):
            raise CardError(refusal)
        try:
            return _CARD.validate_python(fields)
        except ValidationError as error:
            first = error.errors()[0]
            where = ".".join(map(str, first["loc"])) or "it"
            raise CardError(f"the twin's card cannot be used: {where}: {first['msg']}; train it again") from error


_CARD = TypeAdapter(TwinCard)
