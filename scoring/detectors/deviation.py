"""Standard deviation of a low-passed and of a summed residual: the unit of the limits of statistics.

The healthy residual is assumed to be first-order autoregressive, with correlation phi from sample to sample.
"""

from __future__ import annotations

import math


def smoothed_deviation(smoothing_s: float, autocorrelation_time_s: float, period_s: float) -> float:
    """Standard deviation of the low-passed residual, in that of the residual."""
    keep = math.exp(-period_s / smoothing_s) if smoothing_s > 0 else 0.0
    phi = math.exp(-period_s / autocorrelation_time_s) if autocorrelation_time_s > 0 else 0.0
    return math.sqrt((1.0 - keep) / (1.0 + keep) * (1.0 + keep * phi) / (1.0 - keep * phi))


def summed_deviation(autocorrelation_time_s: float, period_s: float) -> float:
    """Standard deviation of the sum of residual times step over one second, for sums over many correlation times."""
    phi = math.exp(-period_s / autocorrelation_time_s) if autocorrelation_time_s > 0 else 0.0
    return math.sqrt(period_s * (1.0 + phi) / (1.0 - phi))
