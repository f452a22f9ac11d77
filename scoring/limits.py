"""What scores are measured against: how healthy residuals behave, and the limit of every detector.

`fantwin calibrate` writes this into the twin's card as `calibration`; docs/how-to/calibrate.md explains each entry. A
twin that was not calibrated has a limit on its smoothed speed residual only, from the scorer's settings.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict, Field, SerializeAsAny, ValidationError, field_validator
from pydantic_core import PydanticCustomError

from scoring.baseline.healthy_residual import HealthyResidual
from scoring.baseline.shared_offset import LEAST_FANS
from scoring.detectors.detector import DetectorSettings, Signal
from scoring.detectors.missing_readings import MissingReadingsSettings
from scoring.detectors.smoothed import SmoothedSettings
from scoring.detectors.table import rows
from scoring.detectors.tacho import TachoSettings

NEVER_S = 1e9
ADAPTATION_BESIDE_OTHERS_S = 300.0
Settings = TypeVar("Settings", bound=DetectorSettings)


class _Entry(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class Timing(_Entry):
    """The times for which limits are valid. With other times the false-alarm rate differs."""

    smoothing_s: float = Field(default=0.2, ge=0, description="time constant of the low-pass of residuals")
    baseline_s: float = Field(default=1.0, gt=0, description="length of an interval that a baseline is learned from")
    adaptation_s: float = Field(default=60.0, gt=0, description="time constant of the baseline in the long run")
    on_delay_s: float = Field(default=0.1, ge=0, description="how long a limit must be exceeded to raise an alarm")


def default_timing(fans: int) -> Timing:
    """Of a tray of so many fans. What they share is followed apart (scoring.baseline.shared_offset); the rest of a
    healthy offset changes slowly, and a baseline that followed faster would follow a fan that clogs.
    """
    return Timing(adaptation_s=ADAPTATION_BESIDE_OTHERS_S) if fans >= LEAST_FANS else Timing()


class DeclaredRate(_Entry):
    """The declared false-alarm rate, and the healthy data behind it."""

    false_alarms_per_day: float = Field(gt=0, description="declared, for each fan")
    interval_95: tuple[float, float] = Field(
        description="95 % confidence interval of the rate of the limits without margins, from their healthy runs"
    )
    extrapolated: bool = Field(description="limits are extrapolated beyond the healthy data; the rate is a target only")
    fan_hours: float = Field(gt=0, description="length of the healthy runs, summed over fans")
    runs: int = Field(ge=1, description="number of runs")
    data: tuple[dict[str, Any], ...] = Field(
        default=(), description="the recordings: name and SHA-256, from_s, to_s of a part, tray of several"
    )
    created: str = Field(default="", description="when, ISO 8601")


class Limits(_Entry):
    """All limits of a twin."""

    speed: HealthyResidual = Field(description="the healthy speed residual")
    balance: HealthyResidual = Field(description="the healthy torque balance")
    detectors: dict[str, SerializeAsAny[DetectorSettings]] = Field(
        default_factory=dict, description="settings of each detector by its name; one that is missing is not used"
    )
    over_predicted_speed: bool = Field(
        default=False, description="all that depends on the speed is by the predicted speed, not by the readings"
    )
    timing: Timing = Field(default=Timing(), description="the times for which the limits are valid")
    declared_rate: DeclaredRate | None = Field(default=None, description="null where these limits have none")

    @field_validator("detectors", mode="before")
    @classmethod
    def _by_table(cls, entries: Any) -> Any:
        if not isinstance(entries, Mapping):
            return entries
        known = {row.name: row.detector.settings for row in rows()}
        for name in entries:
            if name not in known:
                raise PydanticCustomError("unknown_detector", "{name}: there is no such detector", {"name": name})
        return {name: _settings_of(name, known[name], entries[name]) for name in known if name in entries}

    def of(self, fans: Sequence[int] | None) -> Limits:
        """Limits of a tray with some of the fans; None: of fans that the twin does not know one by one."""

        def part(of: HealthyResidual) -> HealthyResidual:
            offsets = of.fan_offsets.of(fans) if of.fan_offsets and fans is not None else None
            stds = of.low_frequency_std_of_fans
            known = tuple(stds[fan % len(stds)] for fan in fans) if stds and fans is not None else ()
            return of.model_copy(update={"fan_offsets": offsets, "low_frequency_std_of_fans": known})

        return self.model_copy(update={"speed": part(self.speed), "balance": part(self.balance)})

    def residual(self, source: Signal) -> HealthyResidual:
        """The healthy residual of a source; ValueError for the tacho, which has none."""
        match source:
            case "speed":
                return self.speed
            case "balance":
                return self.balance
            case "tacho":
                raise ValueError("the tacho has no residual")

    def with_residuals(self, change: Callable[[HealthyResidual, Signal], HealthyResidual]) -> Limits:
        """The same with the healthy residual of each source changed."""
        return self.model_copy(
            update={"speed": change(self.speed, "speed"), "balance": change(self.balance, "balance")}
        )

    def settings_of(self, source: Signal, kind: type[Settings]) -> Settings | None:
        """Settings of a kind of detector on a source; None where it is not used."""
        of_source = (self.detectors.get(row.name) for row in rows() if row.source == source)
        return next((settings for settings in of_source if isinstance(settings, kind)), None)

    def with_detectors(self, **settings: DetectorSettings) -> Limits:
        """The same with these detectors, by name."""
        return self.model_copy(update={"detectors": {**self.detectors, **settings}})

    def times(self, factor: float) -> Limits:
        """The same with every limit `factor` times as far. The declared rate is not valid for them."""
        if factor == 1.0:
            return self
        return self.scaled({row.name: factor for row in rows()}).model_copy(update={"declared_rate": None})

    def scaled(self, factors: Mapping[str, float]) -> Limits:
        """The same with the limit of each detector times its factor, by its name. The adaptation limit of a baseline
        goes with the limit of the smoothed residual.
        """
        detectors = {name: settings.scaled(factors[name]) for name, settings in self.detectors.items()}
        changed: dict[str, Any] = {"detectors": detectors}
        for row in rows():
            if row.source != "tacho" and row.detector.settings is SmoothedSettings:
                residual = self.residual(row.source)
                limit = residual.baseline.adaptation_limit_sigmas * factors[row.name]
                baseline = residual.baseline.model_copy(update={"adaptation_limit_sigmas": limit})
                changed[row.source] = residual.model_copy(update={"baseline": baseline})
        return self.model_copy(update=changed)


def _settings_of(name: str, kind: type[DetectorSettings], entry: Any) -> DetectorSettings:
    try:
        return kind.model_validate(entry)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, (name, *first["loc"])))
        raise PydanticCustomError("detector", "{where}: {why}", {"where": where, "why": first["msg"]}) from error


def uncalibrated(alarm_sigmas: float, timing: Timing) -> Limits:
    """Limits of a twin that was not calibrated: alarm_sigmas on the smoothed speed residual, and missing readings."""
    return Limits(
        # a low-pass does not reduce a nearly constant residual: its limit is always in sigma
        speed=HealthyResidual(autocorrelation_time_s=NEVER_S),
        balance=HealthyResidual(),
        detectors={
            "speed_smoothed": SmoothedSettings(limit=alarm_sigmas),
            "sensor": TachoSettings(stuck_s=NEVER_S, missing_share=1.0),
            "missing_readings": MissingReadingsSettings(),
        },
        timing=timing,
    )
