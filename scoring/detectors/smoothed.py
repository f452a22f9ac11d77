"""The low-passed residual: detects a step immediately."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from pydantic import Field

from schemas.messages import Alarm, Array
from scoring.detectors.alarm_units import AlarmUnits
from scoring.detectors.detector import (
    Detector,
    DetectorContext,
    DetectorInput,
    HealthyEvidence,
    LimitRule,
    Signal,
    SingleLimit,
)
from scoring.detectors.deviation import smoothed_deviation
from scoring.detectors.low_pass import LowPass

MIN_CAUTIOUS_LIMIT = 4.0  # standard deviations: with too few healthy data no limit is set below this
BETWEEN_RUNS_STDS = 3.0  # distance of a healthy fan from its baseline at a speed at which its offset is unknown


class SmoothedSettings(SingleLimit):
    """Of Smoothed."""

    rule: ClassVar[LimitRule] = LimitRule.FIRST
    limit: float = Field(
        gt=0, description="largest low-passed residual, in standard deviations of the healthy low-passed residual"
    )

    def cautious_factor(self, evidence: HealthyEvidence) -> float:
        """See DetectorSettings."""
        least = MIN_CAUTIOUS_LIMIT
        if evidence.offset_unknown_at_other_speeds:
            least = max(least, BETWEEN_RUNS_STDS * evidence.between_runs_std / evidence.smoothed_std)
        return max(least / self.limit, 1.0)


class Smoothed(Detector):
    """First-order low-pass of the residual, with the time constant of the scorer's `smoothing_s`."""

    settings = SmoothedSettings

    def __init__(self, settings: SmoothedSettings, context: DetectorContext) -> None:
        self._settings = settings
        self._context = context
        self._low_pass = LowPass(context.fans, context.smoothing_s)

    def update(self, block: DetectorInput) -> Array:
        """See Detector."""
        smoothed = self._low_pass.update(block.persistent, block.valid, block.period_s)
        return np.abs(smoothed) / (self._deviation(block.period_s) * self._settings.limit)

    def reset(self, fans: Array) -> None:
        """See Detector."""
        self._low_pass.reset(fans)

    @property
    def memory_s(self) -> float:
        """See Detector."""
        return self._low_pass.memory_s

    def limit_sigmas(self, period_s: float) -> float:
        """The mean over speeds; at one speed, or in motion, it is more or less as the healthy residual varies."""
        return self._deviation(period_s) * self._settings.limit * self._context.mean_residual_std

    def columns(self) -> dict[str, Array]:
        """See ColumnState."""
        return {"low_pass": self._low_pass.value}

    @classmethod
    def text(cls, alarm: Alarm, source: Signal, units: AlarmUnits) -> str:
        """See Detector."""
        return units.shift(alarm, source)

    def _deviation(self, period_s: float) -> float:
        return smoothed_deviation(self._context.smoothing_s, self._context.autocorrelation_time_s, period_s)
