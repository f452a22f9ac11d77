"""Growth of the residual's standard deviation: detects vibration, a loose blade, a noisy tacho.

The statistic is the root of the low-passed square of the residual less its own low-pass, in sigma. A fault may raise it
without changing the mean of the residual.
"""

from __future__ import annotations

import numpy as np
from pydantic import Field, model_validator

from schemas.messages import Alarm, Array
from scoring.detectors.alarm_units import AlarmUnits
from scoring.detectors.detector import (
    Detector,
    DetectorContext,
    DetectorInput,
    HealthyEvidence,
    Signal,
    SingleLimit,
)
from scoring.detectors.low_pass import LowPass

TIME_CONSTANT_S = 1.0
MIN_GROWTH = 0.01  # a limit is at least by this share above the healthy value
MIN_CAUTIOUS_LIMIT = 2.5  # times the healthy value: with too few healthy data no limit is set below this


class VarianceGrowthSettings(SingleLimit):
    """Of VarianceGrowth."""

    limit: float = Field(gt=0, description="largest standard deviation, in that of the healthy residual at this speed")
    healthy: float = Field(default=0.0, ge=0, description="mean of the statistic of healthy fans, from which it grows")

    @model_validator(mode="after")
    def _limit_is_above_healthy(self) -> VarianceGrowthSettings:
        if self.limit <= self.healthy:
            raise ValueError("limit must be above healthy")
        return self

    def scaled(self, factor: float) -> VarianceGrowthSettings:
        """The growth is `factor` times as large."""
        return self.model_copy(update={"limit": self.healthy + (self.limit - self.healthy) * factor})

    def calibrated(self, level: float, evidence: HealthyEvidence) -> VarianceGrowthSettings:
        """See DetectorSettings."""
        healthy = evidence.mean_ratio * self.limit
        return self.model_copy(
            update={"healthy": healthy, "limit": max(level * self.limit, (1.0 + MIN_GROWTH) * healthy)}
        )

    def cautious(self, evidence: HealthyEvidence) -> VarianceGrowthSettings:
        """See DetectorSettings."""
        return self.model_copy(update={"limit": max(self.limit, MIN_CAUTIOUS_LIMIT * max(self.healthy, 1.0))})


class VarianceGrowth(Detector):
    """Growth of the standard deviation beyond its healthy value, in multiples of the growth at the limit."""

    settings = VarianceGrowthSettings

    def __init__(self, settings: VarianceGrowthSettings, context: DetectorContext) -> None:
        self._settings = settings
        self._mean = LowPass(context.fans, context.smoothing_s)
        self._square = LowPass(context.fans, TIME_CONSTANT_S)

    def update(self, block: DetectorInput) -> Array:
        """See Detector."""
        healthy = self._settings.healthy
        deviation = self._deviation(block.standardised, block.valid, block.period_s)
        return np.maximum(deviation - healthy, 0.0) / (self._settings.limit - healthy)

    def _deviation(self, residual: Array, valid: Array, period_s: float) -> Array:
        beyond = np.where(valid, residual - self._mean.update(residual, valid, period_s), 0.0)
        return np.sqrt(self._square.update(beyond**2, valid, period_s))

    def reset(self, fans: Array) -> None:
        """From zero: only growth is reported, and the statistic rises to its healthy value from below."""
        self._mean.reset(fans)
        self._square.reset(fans)

    @property
    def memory_s(self) -> float:
        """See Detector."""
        return max(self._mean.memory_s, self._square.memory_s)

    def columns(self) -> dict[str, Array]:
        """See ColumnState."""
        return {"mean": self._mean.value, "square": self._square.value}

    @classmethod
    def text(cls, alarm: Alarm, source: Signal, units: AlarmUnits) -> str:
        """See Detector."""
        return f"unsteady, {alarm.score:.1f} times the limit"
