"""CUSUMs of the residual: one detects a small shift that stays, one a large shift sooner."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
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
CAUTIOUS_SHARE = 0.7  # of a tacho that counts, of the error of a count and of the means over ten: see `cautious`
CAUTIOUS_S = 25.0  # and so long a shift of twice the reference value lasts at least
LARGE_SHARE = 1.5  # of the reference value: that of the sum for large shifts
CAUTIOUS_LARGE_S = 3.0  # and so long a shift of twice that lasts
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
    large_limit: float | None = Field(
        default=None,
        gt=0,
        description="the same of a second sum, for shifts beyond 1.5 reference values; None: there is none",
    )
    period_s: float = Field(gt=0, description="sampling period of the healthy runs, for the deviation of their sum")

    @classmethod
    def unreached(cls) -> DriftSettings:
        """With any period, which `prepared` replaces."""
        return cls(limit=UNREACHED, period_s=1.0)

    def scaled(self, factor: float) -> DriftSettings:
        """See DetectorSettings."""
        large = None if self.large_limit is None else self.large_limit * factor
        return self.model_copy(update={"limit": self.limit * factor, "large_limit": large})

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
        """With too few data the reference value is larger by what is not known, or a shift has to last longer.

        With a counting tacho the reference value is 70 % of the larger of the error of a count and the 99.9 % quantile
        of means over ten counts, and at least the standard deviation of the offsets between runs. They do not show for
        how long the twin errs in one direction, so a shift has to last. A large shift need not last as long. With 50 %
        instead of 70 %, twins that err by 20 rpm at some speeds raise alarms.
        """
        if not evidence.count_std:
            return self.model_copy(update={"reference_sigmas": self.reference_sigmas * evidence.unknown_factor})
        reference = max(CAUTIOUS_SHARE * max(evidence.mean_limit, evidence.count_std), evidence.between_runs_std)
        limit = max(self.limit, CAUTIOUS_S * reference / evidence.summed_std)
        large_limit = CAUTIOUS_LARGE_S * LARGE_SHARE * reference / evidence.summed_std
        return self.model_copy(update={"reference_sigmas": reference, "limit": limit, "large_limit": large_limit})


class DriftSum(NamedTuple):
    """One of its sums."""

    reference_sigmas: float
    limit_sigma_s: float


class Drift(Detector):
    """Two-sided CUSUMs (scoring.detectors.cusum) in multiples of their limits; the larger multiple decides."""

    settings = DriftSettings
    is_sum = True

    def __init__(self, settings: DriftSettings, context: DetectorContext) -> None:
        self._settings = settings
        self._mean_residual_std = context.mean_residual_std
        references, limits = [settings.reference_sigmas], [settings.limit]
        if settings.large_limit is not None:
            references.append(LARGE_SHARE * settings.reference_sigmas)
            limits.append(settings.large_limit)
        self.period_s = settings.period_s
        deviation = summed_deviation(context.autocorrelation_time_s, self.period_s)
        self.sums = [
            DriftSum(*of_one) for of_one in zip(references, [deviation * limit for limit in limits], strict=True)
        ]
        self._limits_sigma_s = np.array([each.limit_sigma_s for each in self.sums])[:, np.newaxis]
        caps = [CAP_LIMITS * limit * deviation if context.capped else math.inf for limit in limits]
        self.cusum = Cusum(context.fans, references, caps)

    def update(self, block: DetectorInput) -> Array:
        """See Detector."""
        sums = self.cusum.update(block.persistent, block.valid, block.period_s)
        ratios: Array = sums / self._limits_sigma_s
        return ratios.max(axis=1)

    def reset(self, fans: Array) -> None:
        """See Detector."""
        self.cusum.reset(fans)

    @property
    def memory_s(self) -> float:
        """The time in which a residual of zero takes a sum at its cap back to zero."""
        return max(CAP_LIMITS * each.limit_sigma_s / each.reference_sigmas for each in self.sums)

    def limit_sigmas(self, period_s: float) -> float:
        """The reference value: any larger shift adds up until it reaches the limit."""
        return self._settings.reference_sigmas * self._mean_residual_std

    def columns(self) -> dict[str, Array]:
        """See ColumnState."""
        return dict(zip(("sums", "large_sums"), self.cusum.sums, strict=False))

    @classmethod
    def text(cls, alarm: Alarm, source: Signal, units: AlarmUnits) -> str:
        """See Detector."""
        return f"{units.shift(alarm, source)}, for long"
