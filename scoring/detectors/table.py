"""The table of detectors: every statistic of the scorer has one row here."""

from __future__ import annotations

from schemas.enums import Statistic
from scoring.detectors.detector import DetectorRow, LimitRule
from scoring.detectors.drift import Drift
from scoring.detectors.missing_readings import MissingReadings
from scoring.detectors.running_on import RunningOn
from scoring.detectors.smoothed import Smoothed
from scoring.detectors.standstill import StandstillDetector
from scoring.detectors.tacho import Tacho
from scoring.detectors.variance_growth import VarianceGrowth

DETECTORS = (
    DetectorRow("speed_smoothed", Statistic.SPEED_SMOOTHED, "speed", Smoothed),
    DetectorRow("speed_drift", Statistic.SPEED_DRIFT, "speed", Drift),
    DetectorRow("speed_variance_growth", Statistic.SPEED_VARIANCE_GROWTH, "speed", VarianceGrowth),
    DetectorRow("balance_smoothed", Statistic.BALANCE_SMOOTHED, "balance", Smoothed),
    DetectorRow("balance_drift", Statistic.BALANCE_DRIFT, "balance", Drift),
    DetectorRow("balance_variance_growth", Statistic.BALANCE_VARIANCE_GROWTH, "balance", VarianceGrowth),
    DetectorRow("sensor", Statistic.SENSOR, "tacho", Tacho),
    DetectorRow("missing_readings", Statistic.SENSOR, "tacho", MissingReadings),
    DetectorRow("standstill", Statistic.STANDSTILL, "tacho", StandstillDetector, comes_first=True),
    DetectorRow("running_on", Statistic.STANDSTILL, "tacho", RunningOn, comes_first=True, only_at_rest=True),
)


def rows() -> tuple[DetectorRow, ...]:
    """All rows. Of statistics equally close to their limits the first one is reported."""
    return DETECTORS


def calibrated_rows() -> tuple[DetectorRow, ...]:
    """The rows whose limits calibration sets."""
    return tuple(row for row in rows() if row.detector.settings.rule is not LimitRule.GIVEN)


def row_of(statistic: int) -> DetectorRow | None:
    """The row of a statistic; None for none, or for one of a newer version."""
    return next((row for row in rows() if row.statistic == statistic), None)
