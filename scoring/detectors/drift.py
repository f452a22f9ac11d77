"""A CUSUM of the residual: detects a small shift that stays."""

from __future__ import annotations

import math

from pydantic import Field

from schemas.messages import Alarm, Array
from scoring.detectors.alarm_units import AlarmUnits
from scoring.detectors.cusum import Cusum
from scoring.detectors.detector import (
    UNREACHED,
    Detector,
    DetectorContext,
    DetectorInput,
    HealthyEvidence,
    Signal,
    SingleLimit,
)
from scoring.detectors.deviation import summed_deviation

CAP_LIMITS = 1.05  # the sum is capped here: a long fault clears soon after it ends, and drift alone stays a warning
MIN_CAUTIOUS_LIMIT = 2.0  # standard deviations: with too few healthy data no limit is set below this
CAUTIOUS_S = 15.0  # of a tacho that counts: so long a shift of twice the reference value lasts at least
REFERENCE_SHARE = 0.25  # of the limit of the smoothed residual, and at least so many sigma
DEFAULT_REFERENCE_SIGMAS = 0.5


class DriftSettings(SingleLimit):
    """Of Drift."""

    limit: float = Field(gt=0, description="largest sum, in standard deviations of a healthy sum over one second")
    reference_sigmas: float = Field(
        default=DEFAULT_REFERENCE_SIGMAS,
        gt=0,
        description="reference value k of the CUSUM: smaller shifts do not add up",
    )
    period_s: float = Field(gt=0, description="sampling period of the healthy runs, for the deviation of their sum")

    @classmethod
    def unreached(cls) -> DriftSettings:
        """With any period, which `prepared` replaces."""
        return cls(limit=UNREACHED, period_s=1.0)

    def prepared(self, evidence: HealthyEvidence) -> DriftSettings:
        """The reference value is above the short means of healthy residuals, and above their typical offsets."""
        least = max(REFERENCE_SHARE, evidence.between_runs_std)
        of_smoothed = REFERENCE_SHARE * evidence.smoothed_limit * evidence.smoothed_std
        reference = max(of_smoothed, evidence.mean_limit, least)
        return self.model_copy(update={"reference_sigmas": reference, "period_s": evidence.period_s})

    def cautious_factor(self, evidence: HealthyEvidence) -> float | None:
        """See DetectorSettings."""
        if evidence.offset_unknown_at_other_speeds:
            return None
        return max(MIN_CAUTIOUS_LIMIT / self.limit, 1.0)

    def cautious(self, evidence: HealthyEvidence) -> DriftSettings:
        """With too few data the reference value is larger by what is not known.

        Of a tacho that counts it is above the error of a count and the means over ten. For how long the twin errs in
        one direction these cannot know, so a shift has to last.
        """
        if not evidence.count_std:
            return self.model_copy(update={"reference_sigmas": self.reference_sigmas * evidence.unknown_factor})
        reference = max(evidence.mean_limit, evidence.count_std)
        limit = max(self.limit, CAUTIOUS_S * reference / evidence.summed_std)
        return self.model_copy(update={"reference_sigmas": reference, "limit": limit})


class Drift(Detector):
    """Two-sided CUSUM (scoring.detectors.cusum) in multiples of its limit."""

    settings = DriftSettings

    def __init__(self, settings: DriftSettings, context: DetectorContext) -> None:
        self._settings = settings
        self._mean_residual_std = context.mean_residual_std
        deviation = summed_deviation(context.autocorrelation_time_s, settings.period_s)
        self.limit_sigma_s = deviation * settings.limit
        """the limit of the sum, sigma seconds"""
        self.reference_sigmas, self.period_s = settings.reference_sigmas, settings.period_s
        cap = CAP_LIMITS * settings.limit * deviation if context.capped else math.inf
        self._cusum = Cusum(context.fans, settings.reference_sigmas, cap)

    def update(self, block: DetectorInput) -> Array:
        """See Detector."""
        return self._cusum.update(block.persistent, block.valid, block.period_s) / self.limit_sigma_s

    def reset(self, fans: Array) -> None:
        """See Detector."""
        self._cusum.reset(fans)

    @property
    def memory_s(self) -> float:
        """The time in which a residual of zero takes a sum at its cap back to zero."""
        return CAP_LIMITS * self.limit_sigma_s / self._settings.reference_sigmas

    def limit_sigmas(self, period_s: float) -> float:
        """The reference value: any larger shift adds up until it reaches the limit."""
        return self._settings.reference_sigmas * self._mean_residual_std

    def columns(self) -> dict[str, Array]:
        """See ColumnState."""
        return {"sums": self._cusum.sums}

    @classmethod
    def text(cls, alarm: Alarm, source: Signal, units: AlarmUnits) -> str:
        """See Detector."""
        return f"{units.shift(alarm, source)}, for long"
