"""The model card: what a twin is and how good it is, as JSON inside its ONNX file (metadata `fantwin.card`)."""

import json
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any, Literal

from pydantic import ConfigDict, TypeAdapter, ValidationError
from pydantic.dataclasses import dataclass

from twin.errors import TwinError
from twin.fitting.balance import Source
from twin.models.model import Kind
from twin.models.state import StateLayout

FORMAT_VERSION = 3
CARD_KEY = "fantwin.card"

STRICT = ConfigDict(extra="forbid", allow_inf_nan=False)


@dataclass(frozen=True, config=STRICT)
class NetworkCard:
    """The network, empty for the physical model. parameter_count: the trained weights, physics not counted."""

    units: int
    inputs: tuple[str, ...]
    parameter_count: int


@dataclass(frozen=True, config=STRICT)
class DataCard:
    """One file of training data."""

    name: str
    sha256: str
    fans: int
    samples: int


@dataclass(frozen=True, config=STRICT)
class TrainingCard:
    """How the twin was made.

    physics: whether they were refined along with the network. duration_s: how long training took. fans: the numbers
    that the recordings give to the fans, in order; empty in files made before they were written down.
    """

    trainer: str
    physics: Literal["fixed", "refined"]
    seed: int
    iterations: int
    duration_s: float
    data: tuple[DataCard, ...]
    fans: tuple[int, ...] = ()


@dataclass(frozen=True, config=STRICT)
class ValidationCard:
    """Free-run figures pooled over fans, in rad/s. None where a figure is undefined.

    source says whether the runs were held out or are the training runs themselves. data: the files held out.
    """

    source: Literal["held-out", "training"]
    data: tuple[DataCard, ...]
    samples: int
    rmse: float | None
    max_error: float | None
    r2: float | None
    one_step_rmse: float | None
    coverage_2_sigma: float | None


@dataclass(frozen=True, config=STRICT)
class HealthyCard:
    """The healthy free-run residual, one entry a fan; None where the runs were too short to tell.

    autocorrelation_time_s, independent_samples: see residual_analysis.ResidualAnalysis. quantiles_sigma: the
    magnitudes, in sigma, that a healthy sample stays below with the given probabilities. max_sigma: the largest seen.
    """

    autocorrelation_time_s: tuple[float | None, ...]
    independent_samples: tuple[float | None, ...]
    probabilities: tuple[float, ...]
    quantiles_sigma: tuple[tuple[float | None, ...], ...]
    max_sigma: tuple[float | None, ...]


@dataclass(frozen=True, config=STRICT)
class BalanceCard:
    """The torque balance (twin.fitting.balance), one entry a fan, in command units with rad/s and s.

    std_errors: of inertia, viscous, drag and friction. covariance: of these errors, None in cards that
    do not have it. source: which candidate they are, see twin.fitting.balance_fit.
    sigma_command: the healthy standard deviation of the balance within a run. lowest_speed_rad_s: below it the balance
    means nothing.
    """

    inertia: tuple[float, ...]
    viscous: tuple[float, ...]
    drag: tuple[float, ...]
    friction: tuple[float, ...]
    std_errors: tuple[tuple[float, float, float, float], ...]
    lag_s: tuple[float, ...]
    source: tuple[Source, ...]
    sigma_command: tuple[float, ...]
    autocorrelation_time_s: tuple[float, ...]
    lowest_speed_rad_s: tuple[float, ...]
    filter_rate_per_s: float
    covariance: tuple[tuple[tuple[float, float, float, float], ...], ...] | None = None


@dataclass(frozen=True, config=STRICT)
class Card:
    """Everything a reader of the file needs to know. Lists per fan come in the order of the fans.

    parameters: those in force, per fan, in the order of parameter_names. identified_parameters, parameter_std_errors:
    those of the physical model alone, with their standard errors; a refined twin's own differ, because its network
    has taken a share. sigma_rad_s: per fan, the healthy root mean square free-run error. The ranges are those seen in
    training: outside them the twin is a guess. calibration: of the alarms, once they have been calibrated.
    """

    kind: Kind
    name: str
    created: str
    fans: int
    n_state: int
    state_layout: StateLayout
    parameter_names: tuple[str, ...]
    parameters: tuple[tuple[float, ...], ...]
    identified_parameters: tuple[tuple[float, ...], ...]
    parameter_std_errors: tuple[tuple[float, ...], ...]
    parameter_interval_95: tuple[tuple[tuple[float, float], ...], ...]
    sigma_rad_s: tuple[float, ...]
    healthy: HealthyCard
    balance: BalanceCard
    speed_range_rad_s: tuple[float, float]
    command_range: tuple[float, float]
    rate_hz: float
    network: NetworkCard
    training: TrainingCard
    validation: ValidationCard
    versions: dict[str, str]
    command_unit: str
    speed_unit: Literal["rad/s"] = "rad/s"
    calibration: dict[str, Any] | None = None
    format_version: int = FORMAT_VERSION

    @property
    def fan_numbers(self) -> tuple[int, ...]:
        """What the recordings call the fans; counted from 0 where the card does not say."""
        return self.training.fans or tuple(range(self.fans))

    def rows(self, fans: int, fan_numbers: Sequence[int] | None = None) -> list[int]:
        """Which entries of the lists per fan are those of the fans of some runs.

        fan_numbers: of the fans chosen from the recordings; without a choice it is all of them, counted from 0. A twin
        of one fan serves any. Raises TwinError where it cannot be told which fan is which.
        """
        if self.fans == 1:
            return [0] * fans
        named, numbers = self.training.fans, tuple(fan_numbers or range(fans))
        if not named and fans == self.fans:
            return list(range(fans))
        if numbers == named or (fan_numbers and set(numbers) <= set(named)):
            return [named.index(number) for number in numbers]
        of_runs = ", ".join(map(str, numbers))
        if named:
            of_twin = ", ".join(map(str, named))
            raise TwinError(
                f"twin {self.name!r} is of fans {of_twin}, the runs of {of_runs}; "
                "choose its fans with --fans, or retrain"
            )
        raise TwinError(
            f"twin {self.name!r} is of {self.fans} fans and does not say which, the runs of {of_runs}; "
            "give recordings of as many fans, or retrain"
        )

    def to_json(self) -> str:
        """One line of JSON."""
        return json.dumps(asdict(self), allow_nan=False)

    @staticmethod
    def from_json(text: str) -> "Card":
        """Read a card. Raises TwinError, in one line, when it is not one or is of an unknown format."""
        try:
            fields: Any = json.loads(text)
        except json.JSONDecodeError as error:
            raise TwinError(f"the model card is not JSON ({error}); export the twin again") from error
        version = fields.get("format_version") if isinstance(fields, dict) else None
        if version != FORMAT_VERSION:
            raise TwinError(
                f"the model card has format_version {version!r}, this program reads {FORMAT_VERSION}; "
                "export the twin again, or use the program that made it"
            )
        try:
            return _CARD.validate_python(fields)
        except ValidationError as error:
            first = error.errors()[0]
            where = ".".join(str(part) for part in first["loc"])
            raise TwinError(f"the model card's {where} is wrong: {first['msg']}; export the twin again") from error


_CARD = TypeAdapter(Card)
