"""What the healthy runs say to each detector, from which it sets itself up: HealthyEvidence."""

from __future__ import annotations

from scoring.calibration.healthy_statistics import HealthyStatistics
from scoring.calibration.healthy_variation import between_runs_std
from scoring.detectors.detector import DetectorRow, HealthyEvidence, Signal
from scoring.detectors.deviation import smoothed_deviation, summed_deviation
from scoring.detectors.smoothed import SmoothedSettings
from scoring.limits import Limits

COARSE_COUNTS = 0.25  # errors of counts that are smaller, in standard deviations of the residual, do not matter
MEANS_QUANTILE = 0.999  # of means over a second or ten counts: a shift that is exceeded more often is not a drift


def evidence(row: DetectorRow, limits: Limits, found: HealthyStatistics) -> HealthyEvidence:
    """Of the detector in a row of the table, with the limits so far."""
    if row.source == "tacho":
        return HealthyEvidence(period_s=found.period_s)
    smoothed, moments = limits.settings_of(row.source, SmoothedSettings), found.moments[row.source]
    residual = limits.residual(row.source)
    return HealthyEvidence(
        period_s=found.period_s,
        mean_ratio=found.mean_ratio(row),
        smoothed_std=smoothed_std(limits, row.source, found),
        summed_std=summed_deviation(residual.autocorrelation_time_s, found.period_s),
        smoothed_limit=smoothed.limit if smoothed else 0.0,
        mean_limit=moments.mean_quantile(MEANS_QUANTILE),
        count_std=count_std(limits, found) if row.source == "speed" else 0.0,
        between_runs_std=between_runs_std(moments, residual),
        # the friction of a day shifts the balance equally at all speeds, but not the speed
        offset_unknown_at_other_speeds=row.source == "speed" and residual.baseline.speed_exponent == 0,
    )


def count_std(limits: Limits, found: HealthyStatistics) -> float:
    """The largest error of a count among the fans, in that of the speed residual; 0 where none of them matters."""
    std = found.count_sigmas / limits.speed.mean_residual_std
    return std if std >= COARSE_COUNTS else 0.0


def smoothed_std(limits: Limits, source: Signal, found: HealthyStatistics) -> float:
    """Standard deviation of the low-passed residual, in that of the residual."""
    return smoothed_deviation(limits.timing.smoothing_s, limits.residual(source).autocorrelation_time_s, found.period_s)
