"""The residual over minutes: detects what grows slowly, and what is too small to be seen at once.

A low-pass of a minute against a baseline that follows as slowly keeps what changes within minutes: an inlet that clogs,
a bearing that costs a few per cent. What changes over hours, as the weather and the supply do, the baseline takes out.
Above half of the limit the baseline stays, so that it cannot follow the fault either.
"""

from __future__ import annotations

import numpy as np

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

TIME_CONSTANT_S = 60.0
MIN_LIMIT = 0.25
BETWEEN_RUNS_STDS = 3.0  # with too few healthy data no limit is below so many of those of healthy baselines


class SlowSettings(SingleLimit):
    """Of Slow. limit: in healthy standard deviations of the residual."""

    def scaled(self, factor: float) -> SlowSettings:
        """See DetectorSettings. Runs of minutes show next to nothing of what changes within minutes: a limit from them
        would be near zero.
        """
        return self.model_copy(update={"limit": max(self.limit * factor, MIN_LIMIT)})

    def cautious_factor(self, evidence: HealthyEvidence) -> float | None:
        """See DetectorSettings. Short data show too little of how a residual varies over minutes."""
        if evidence.offset_unknown_at_other_speeds:
            return None
        return max(BETWEEN_RUNS_STDS * evidence.between_runs_std / self.limit, 1.0)


class Slow(Detector):
    """First-order low-pass of the residual over a minute."""

    settings = SlowSettings

    def __init__(self, settings: SlowSettings, context: DetectorContext) -> None:
        self._settings = settings
        self._context = context
        self._low_pass = LowPass(context.fans, TIME_CONSTANT_S)

    def update(self, block: DetectorInput) -> Array:
        """See Detector."""
        slow = self._low_pass.update(block.persistent, block.valid, block.period_s)
        return np.asarray(np.abs(slow) / self._settings.limit)

    def reset(self, fans: Array) -> None:
        """See Detector."""
        self._low_pass.reset(fans)

    @property
    def memory_s(self) -> float:
        """See Detector."""
        return self._low_pass.memory_s

    def limit_sigmas(self, period_s: float) -> float:
        """The mean over speeds, as of Smoothed."""
        return self._settings.limit * self._context.mean_residual_std

    def columns(self) -> dict[str, Array]:
        """See ColumnState."""
        return {"low_pass": self._low_pass.value}

    @classmethod
    def text(cls, alarm: Alarm, source: Signal, units: AlarmUnits) -> str:
        """See Detector."""
        return f"{units.shift(alarm, source)}, for minutes"
