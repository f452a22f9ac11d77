"""Keys of scorer snapshots that earlier versions wrote. Recordings and run folders contain them, so they are read."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

FORMER_SCORER_KEYS = {"judge": "scorer", "desk": "alarms", "fed_by": "input_producer"}
FORMER_ALARM_KEYS = {"told": "last_emitted"}
FORMER_CONDITION_KEYS = {"lasted_ns": "held_ns"}
FORMER_WEAR_KEYS = {"tried": "last_attempt"}
FORMER_PARAMETER_KEYS = {"why_not": "unknown_reason", "invalid_reason": "unknown_reason"}
FORMER_FAN_SCORER_KEYS = {
    "quiet": "below_half_limit",
    "normal": "within_limit",
    "motion_past": "motion.past",
    "sensor_last": "detectors.sensor.last",
    "sensor_since_ns": "detectors.sensor.repeated_ns",
    "sensor_missing": "detectors.sensor.missing",
}
"""former entry -> its path today; origin_t_ns and interval kept their names"""
FORMER_RESIDUAL_KEYS = {
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


def current_keys(stored: Mapping[str, Any], former: Mapping[str, str]) -> dict[str, Any]:
    """The same values under the keys of today. former: former key -> key of today."""
    return {former.get(key, key): value for key, value in stored.items()}


def current_fan_scorer(state: Mapping[str, Any]) -> dict[str, Any]:
    """A former snapshot of a FanScorer in the form of today. What is missing stays missing."""
    names = FORMER_FAN_SCORER_KEYS | {
        f"{residual}_{former}": path.format(residual=residual)
        for residual in ("speed", "balance")
        for former, path in FORMER_RESIDUAL_KEYS.items()
    }
    made: dict[str, Any] = {}
    for name, value in state.items():
        *parents, last = names.get(name, name).split(".")
        place = made
        for parent in parents:
            place = place.setdefault(parent, {})
        place[last] = value
    return made
