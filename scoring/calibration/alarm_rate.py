"""Confidence interval of a rate of alarms that were counted (Garwood, Biometrika 28 (1936) 437)."""

from __future__ import annotations

COVERAGE = 0.95
HOURS_PER_DAY = 24.0


def daily_interval(count: float, fan_hours: float) -> tuple[float, float]:
    """Compute the 95 % interval of the rate per fan and day from the count in `fan_hours`."""
    from scipy.special import gammaincinv  # noqa: PLC0415  scipy takes long to import, and stages do without

    outside = (1.0 - COVERAGE) / 2
    low = gammaincinv(count, outside) if count > 0 else 0.0
    high = gammaincinv(count + 1, 1.0 - outside)
    return float(low) / fan_hours * HOURS_PER_DAY, float(high) / fan_hours * HOURS_PER_DAY
