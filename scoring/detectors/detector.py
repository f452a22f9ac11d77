"""What a detector is: one statistic of every fan of a tray, in multiples of its limit.

A detector is one file with its class and its settings, and one row in scoring/detectors/table.py. No other code names
it: scores, limits, calibration, snapshots and alarm texts use the table.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import ClassVar, Literal, Self

from pydantic import BaseModel, ConfigDict, Field

from schemas.messages import Alarm, Array
from schemas.tacho import Tacho
from scoring.column_state import ColumnState
from scoring.detectors.alarm_units import AlarmUnits

Signal = Literal["speed", "balance", "tacho"]
"""The input of a detector: the speed residual, the torque balance, or the readings of the tacho."""
UNREACHED = 1e6  # a limit that no healthy fan reaches; calibration starts from it


class LimitRule(Enum):
    """How `fantwin calibrate` sets the limit of a detector."""

    FIRST = "by rarity, and before the others: how far residuals are clipped and followed depends on it"
    RARITY = "by rarity: healthy fans exceed it as seldom as the declared false-alarm rate asks"
    GIVEN = "not by calibration: with the twin itself"
    FIXED = "not by rarity: constant, or by the largest value that healthy runs reached (`DetectorSettings.fixed`)"


@dataclass(frozen=True, kw_only=True)
class HealthyEvidence:
    """Statistics of a detector's input over healthy runs, under the limits of that pass. The tacho has no residual."""

    period_s: float
    """sampling period of the runs"""
    mean_ratio: float = 0.0
    """mean of the detector's statistic, in multiples of its limit"""
    smoothed_std: float = 1.0
    """standard deviation of the low-passed standardised residual"""
    summed_std: float = 1.0
    """standard deviation of the sum of the standardised residual over one second"""
    smoothed_limit: float = 0.0
    """limit of the low-passed residual, in these standard deviations"""
    mean_limit: float = 0.0
    """99.9 % quantile of the means of the standardised residual over a second; of tachos that count, over ten counts"""
    count_std: float = 0.0
    """of tachos that count: the error of a reading from the phases of its pulses, in that of the residual"""
    unknown_factor: float = 1.0
    """by how much the standard deviation of so few healthy data may be too small"""
    between_runs_std: float = 0.0
    """standard deviation of the commissioned baselines, in that of the residual"""
    offset_unknown_at_other_speeds: bool = False
    """whether a fan's offset at one speed is unrelated to its offset at another"""


class DetectorSettings(BaseModel, ABC):
    """Settings of a detector, as the twin's card stores them. A detector without settings in the card is not used."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)
    rule: ClassVar[LimitRule]

    @classmethod
    @abstractmethod
    def unreached(cls) -> Self:
        """Settings with limits that no healthy fan reaches."""

    @abstractmethod
    def scaled(self, factor: float) -> Self:
        """The same with limits `factor` times as far."""

    @classmethod
    def fixed(cls, observed: Mapping[str, float]) -> Self:
        """Settings by the rule FIXED. observed: the largest values of healthy runs, see `Detector.observed`."""
        raise NotImplementedError(f"{cls.__name__} has the rule FIXED and no settings for it")

    def prepared(self, evidence: HealthyEvidence) -> Self:
        """The same with what follows from the detectors of the rule FIRST; before the others are calibrated."""
        return self

    def calibrated(self, level: float, evidence: HealthyEvidence) -> Self:
        """The same with limits at `level` times the present ones, which makes excursions as rare as required."""
        return self.scaled(level)

    def cautious_factor(self, evidence: HealthyEvidence) -> float | None:
        """Factor on limits if the healthy data are too short for the declared rate; None: the detector
        is not used then.
        """
        return 1.0

    def cautious(self, evidence: HealthyEvidence) -> Self:
        """Other changes in that case, after the limits were scaled."""
        return self


class SingleLimit(DetectorSettings):
    """Settings with one limit, set by rarity."""

    rule: ClassVar[LimitRule] = LimitRule.RARITY
    limit: float = Field(gt=0, description="largest value of the statistic, in its own unit")

    @classmethod
    def unreached(cls) -> Self:
        """See DetectorSettings."""
        return cls(limit=UNREACHED)

    def scaled(self, factor: float) -> Self:
        """See DetectorSettings."""
        return self.model_copy(update={"limit": self.limit * factor})


@dataclass(frozen=True, kw_only=True)
class DetectorContext:
    """What every detector is built with, beside its settings."""

    fans: int
    smoothing_s: float
    """time constant of the residual's low-pass"""
    autocorrelation_time_s: float = 0.0
    """of the healthy residual; 0: white"""
    mean_residual_std: float = 1.0
    """mean over speeds of the standard deviation of the healthy residual, sigma"""
    tachos: tuple[Tacho, ...] = ()
    """of each fan; only for detectors of the tacho"""
    capped: bool = True
    """False: statistics may grow without bound, for calibration to see how far"""


@dataclass(frozen=True, eq=False, kw_only=True)
class DetectorInput:
    """A block of samples for detectors, (n, fans) each. Both residuals are less expected residual and baseline."""

    period_ns: int
    period_s: float
    """the same in seconds"""
    valid: Array
    """whether the sample counts; where not, a detector keeps its state"""
    standardised: Array
    """the residual in standard deviations of the healthy one at this speed, clipped"""
    persistent: Array
    """the same, divided once more by how much more its low frequencies vary at this speed and in this motion"""
    speed_rad_s: Array
    """the readings of the tacho, NaN where there is none"""
    missing: Array
    """the tacho gave no reading, and its speed is not known from those around it"""
    reading_missing: Array
    """the newest raw sample has no reading"""
    idle: Array
    """the command stops the fan, or it has just started"""
    command: Array
    predicted_rad_s: Array
    """what a healthy fan would read, NaN where it is not known"""


class Detector(ColumnState):
    """One statistic of a tray's fans. The result does not depend on how samples are cut into blocks."""

    settings: ClassVar[type[DetectorSettings]]
    is_sum: ClassVar[bool] = False
    """whether its statistic adds up, and falls only as fast as it may"""

    @abstractmethod
    def __init__(self, settings: DetectorSettings, context: DetectorContext) -> None: ...

    @abstractmethod
    def update(self, block: DetectorInput) -> Array:
        """Take a block of n samples. Returns (n, fans): the statistic in multiples of its limit."""

    @abstractmethod
    def reset(self, fans: Array) -> None:
        """Start again for some fans, (fans,) of bool."""

    @property
    @abstractmethod
    def memory_s(self) -> float:
        """How long samples affect the statistic. After a longer gap it starts again: nothing before it counts."""

    @property
    def off_delay_s(self) -> float:
        """How long the statistic must stay low for its alarm to be over: as long as the fault may still be in it."""
        return self.memory_s

    def limit_sigmas(self, period_s: float) -> float:
        """The smallest constant shift of the residual that the statistic ends up reporting, sigma; inf: it reports
        none, as where it watches something else."""
        return math.inf

    def observed(self) -> dict[str, float]:
        """The largest values so far, by name, from which the rule FIXED may set a limit."""
        return {}

    @classmethod
    @abstractmethod
    def text(cls, alarm: Alarm, source: Signal, units: AlarmUnits) -> str:
        """The alarm text of this statistic, without the fan's number."""


@dataclass(frozen=True)
class DetectorRow:
    """A row of the table of detectors."""

    name: str
    """in the twin's card and in snapshots"""
    statistic: int
    """the value of schemas.messages.Statistic that scores and alarms carry"""
    source: Signal
    detector: type[Detector]
    comes_first: bool = False
    """above its limit it is reported before all others, however far they exceed theirs: it says what is wrong"""
    only_at_rest: bool = False
    """it has a ratio only while the command stops the fan"""
