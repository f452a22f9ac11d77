"""Calibration on runs that a test makes up, which are gone through in its process."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from scoring.calibration import calibration, healthy_statistics
from scoring.calibration.healthy_statistics import HealthyRun, HealthyStatistics, one_after_another
from scoring.limits import Limits

MadeRuns = Callable[[], Iterable[HealthyRun]]
"""Returns the runs from the beginning at each call."""


def calibrate(runs: MadeRuns, *settings: Any, **more: Any) -> Limits:
    return calibration.calibrate(one_after_another(runs), *settings, **more)


def statistics_of(runs: MadeRuns, limits: Limits, top_speed_rad_s: float) -> HealthyStatistics:
    return healthy_statistics.healthy_statistics(one_after_another(runs), limits, top_speed_rad_s)
