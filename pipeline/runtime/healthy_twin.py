"""Configuration of the scorer, and what it knows about the twin of its tray: limits, balances, tachos, standstill."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from pydantic import Field, ValidationError

from pipeline.runtime.stage import Context, StageConfig, StageError
from pipeline.runtime.tray_twin import TrayTwin
from schemas.standstill import Standstill
from schemas.tacho import INSTANTANEOUS, Tacho, tacho_of_each_fan
from scoring.detectors.running_on import RunningOnSettings
from scoring.detectors.standstill import StandstillSettings
from scoring.diagnosis.regression_window import HealthyBalance
from scoring.limits import Limits, Timing, uncalibrated
from scoring.unseen_error import UnseenError

LEAST_OFF_DELAY_S, OFF_DELAY_COUNTS = 1.0, 10.0


class ScorerConfig(StageConfig):
    """Section `[scorer]`. Times that are not given are those that the twin was calibrated with."""

    alarm_sigmas: float = Field(
        default=2.0, gt=0, description="limit on the smoothed speed residual of a twin without calibration, in sigma"
    )
    limit_factor: float = Field(
        default=1.0, gt=0, description="multiplies all limits; above 1: fewer alarms than declared"
    )
    smoothing_s: float | None = Field(default=None, ge=0, description="time constant of the low-pass of residuals")
    baseline_s: float | None = Field(default=None, gt=0, description="length of an interval of commissioning")
    adaptation_s: float | None = Field(default=None, gt=0, description="time constant of the baseline in the long run")
    on_delay_s: float | None = Field(default=None, ge=0, description="how long a limit must be exceeded to raise")
    off_delay_s: float | None = Field(
        default=None,
        ge=0,
        description="shortest return that clears an alarm; it is longer for statistics with a longer memory; "
        "default: 1 s, or ten counts of a counting tacho",
    )
    deadband: float = Field(default=0.5, ge=0, lt=1, description="a return begins below 1 - deadband times the limit")
    alarm_ratio: float = Field(default=1.5, ge=1, description="score from which a warning is an alarm")
    latching: bool = Field(default=False, description="whether a cleared alarm stays until it is reset")
    confirming: bool = Field(default=False, description="whether an acknowledged alarm must be confirmed, too")
    wear_every_s: float = Field(default=600.0, gt=0, description="how often the wear of a fan is measured")
    not_judged_s: float = Field(
        default=10.0,
        gt=0,
        description="health reports a fan without a score for this long; set it above twin_integrator.warm_up_s",
    )

    asks_for_snapshots: bool | None = Field(
        default=None,
        description="whether it continues from the snapshot that a recorder keeps, where that is newer than its own "
        "file, as on another host; with false and without the file, everything starts from the beginning; default: if "
        "it is one of several shards",
    )

    def timing(self, calibrated: Timing) -> Timing:
        """The times in force."""
        own = {name: getattr(self, name) for name in Timing.model_fields}
        return calibrated.model_copy(update={name: value for name, value in own.items() if value is not None})

    def least_off_delay_s(self, tachos: Sequence[Tacho]) -> float:
        """`off_delay_s`, of these tachos where it is not given."""
        if self.off_delay_s is not None:
            return self.off_delay_s
        return max([LEAST_OFF_DELAY_S, *(OFF_DELAY_COUNTS * tacho.held_s for tacho in tachos)])


@dataclass(frozen=True, eq=False)
class HealthyTwin:
    """What the scorer knows about the twin. sha256: identifies its file."""

    sha256: str
    limits: Limits
    balances: Sequence[HealthyBalance]
    command_unit: str = ""
    tachos: tuple[Tacho, ...] = INSTANTANEOUS
    """one for all fans, or one for each"""
    standstill: Standstill | None = None
    highest_command: float = math.inf
    """that it was trained on"""
    unseen_error: UnseenError | None = None
    """where healthy runs do not show it; None: its card says nothing about it"""
    is_calibrated: bool = True
    knows_supply: bool = False
    """whether it needs the supply voltage, and so allows for it"""

    def of_trays(self, count: int, fans: int) -> HealthyTwin:
        """The same for the fans of so many trays with as many fans each; without balances."""
        rows = [*range(fans)] * count
        return replace(
            self,
            limits=self.limits.of(rows),
            balances=(),
            tachos=tacho_of_each_fan(self.tachos, fans) * count,
            unseen_error=self.unseen_error and self.unseen_error.of_fans(rows),
        )


def limits_in_force(
    config: ScorerConfig, calibration: Mapping[str, Any] | None, standstill: Standstill | None = None
) -> Limits:
    """The limits of a twin's card, or those of a twin without calibration, with the scorer's settings applied.

    standstill: of the card; calibration does not change it.

    Raises:
        ValidationError: the calibration is not valid.
    """
    if calibration is None:
        limits = uncalibrated(config.alarm_sigmas, config.timing(Timing()))
        return _with_standstill(limits, standstill).times(config.limit_factor)
    limits = _with_standstill(Limits.model_validate(calibration), standstill)
    timing = config.timing(limits.timing)
    declared_rate = limits.declared_rate if timing == limits.timing else None  # it holds for the calibrated times
    return limits.model_copy(update={"timing": timing, "declared_rate": declared_rate}).times(config.limit_factor)


def _with_standstill(limits: Limits, standstill: Standstill | None) -> Limits:
    if standstill is None:
        return limits
    return limits.with_detectors(
        standstill=StandstillSettings(healthy=standstill), running_on=RunningOnSettings(healthy=standstill)
    )


def healthy_twin(context: Context, twin: TrayTwin) -> HealthyTwin:
    """What a scorer needs to know about the twin of its tray.

    Raises:
        StageError: the twin's calibration cannot be used for this tray.
    """
    again, name = "calibrate it again: fantwin calibrate", context.tray.twin or twin.card.name
    try:
        limits = limits_in_force(context.config, twin.card.calibration, twin.card.standstill)
    except ValidationError as error:
        first = error.errors()[0]
        why = f"{'.'.join(map(str, first['loc']))}: {first['msg']}"
        raise StageError(f"{name}: its calibration cannot be used: {why}; {again}") from error
    for residual in (limits.speed, limits.balance):
        fans = len(residual.fan_offsets.offset_sigmas) if residual.fan_offsets else context.tray.fans
        if len(residual.low_frequency_std_of_fans) not in (0, twin.card.fans):
            fans = len(residual.low_frequency_std_of_fans)
        if fans != context.tray.fans:
            raise StageError(f"{name}: its calibration is of {fans} fans, the tray has {context.tray.fans}; {again}")
    card = twin.card
    return HealthyTwin(
        twin.sha256,
        limits,
        twin.healthy_balances(),
        card.command_unit,
        card.tacho,
        card.standstill,
        card.command_range[1],
        twin.unseen_error,
        card.calibration is not None,
        card.conditions is not None and card.conditions.supply_voltage_v is not None,
    )
