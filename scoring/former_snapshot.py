"""Snapshots of a FanScorer as earlier versions wrote them: recordings and run folders have them, so they are read."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

FORMER_NAMES = {
    "quiet": "below_half_limit",
    "normal": "within_limit",
    "motion_past": "motion.past",
    "sensor_last": "detectors.sensor.last",
    "sensor_since_ns": "detectors.sensor.repeated_ns",
    "sensor_missing": "detectors.sensor.missing",
}
"""former entry -> its path today; origin_t_ns and interval kept their names"""
FORMER_RESIDUAL_NAMES = {
    "baseline": "{residual}.baseline.value",
    "commissioned": "{residual}.baseline.commissioned",
    "intervals": "{residual}.baseline.intervals",
    "waited": "{residual}.baseline.unsteady_intervals",
    "means": "{residual}.baseline.interval_means",
    "told": "{residual}.baseline.interval_information",
    "worth": "{residual}.baseline.total_information",
    "sums": "{residual}.baseline.sums",
    "shapes": "{residual}.baseline.scaling_squares",
    "squares": "{residual}.baseline.squares",
    "counts": "{residual}.baseline.counts",
    "shown": "{residual}.low_pass.value",
    "smoothed": "detectors.{residual}_smoothed.low_pass",
    "cusum": "detectors.{residual}_drift.sums",
    "spread_mean": "detectors.{residual}_variance_growth.mean",
    "square": "detectors.{residual}_variance_growth.square",
}
"""former entry with "speed_" or "balance_" before it -> its path today"""


def upgraded(state: Mapping[str, Any]) -> dict[str, Any]:
    """A former snapshot in the names of today. It keeps what is missing missing."""
    names = FORMER_NAMES | {
        f"{residual}_{former}": path.format(residual=residual)
        for residual in ("speed", "balance")
        for former, path in FORMER_RESIDUAL_NAMES.items()
    }
    made: dict[str, Any] = {}
    for name, value in state.items():
        *parents, last = names.get(name, name).split(".")
        place = made
        for parent in parents:
            place = place.setdefault(parent, {})
        place[last] = value
    return made
