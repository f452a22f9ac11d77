"""Reads the calibrations of cards of format 1, such as that of pipeline/demo/twin.onnx."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

FORMER_FORMAT_VERSION = 1
FORMER_PERIOD_S = 0.01  # the deviation of a summed residual was that of this period, whatever the rate of the runs
FORMER_SENSOR = {"stuck_s": 5.0, "missing_share": 0.25}
FORMER_NAMES = {"stuck_s": "detectors.sensor.stuck_s", "missing_share": "detectors.sensor.missing_share"} | {
    "promise": "declared_rate"
}
"""former entry of the calibration -> its path today"""
FORMER_RESIDUAL_NAMES = {
    "fans": "{residual}.fan_offsets",
    "offset_sigmas": "{residual}.expected_residual_sigmas",
    "spread": "{residual}.residual_std",
    "lasting": "{residual}.persistent_std",
    "motion_rad_s": "{residual}.transient_scale_rad_s",
    "baseline_sigmas": "{residual}.baseline.commissioning_limit_sigmas",
    "adaptation_sigmas": "{residual}.baseline.adaptation_limit_sigmas",
    "baseline_power": "{residual}.baseline.speed_exponent",
    "baseline_speed_rad_s": "{residual}.baseline.reference_speed_rad_s",
    "baseline_bend_rad_s": "{residual}.baseline.crossover_speed_rad_s",
    "baseline_ridge": "{residual}.baseline.ridge",
    "baseline_usual_sigmas": "{residual}.baseline.rms_sigmas",
    "step": "detectors.{residual}_smoothed.limit",
    "drift": "detectors.{residual}_drift.limit",
    "reference_sigmas": "detectors.{residual}_drift.reference_sigmas",
    "growth": "detectors.{residual}_variance_growth.limit",
    "usual_growth": "detectors.{residual}_variance_growth.healthy",
}
"""former entry of `speed` and `balance` -> its path today; the others kept their names"""


def upgraded(calibration: Mapping[str, Any]) -> dict[str, Any]:
    """A calibration of format 1 in the names of today. A statistic whose limit was null has no detector."""
    made: dict[str, Any] = {"speed": {}, "balance": {}, "detectors": {"sensor": dict(FORMER_SENSOR)}}
    for path, value in _entries(calibration):
        *parents, name = path.split(".")
        place = made
        for parent in parents:
            place = place.setdefault(parent, {})
        place[name] = value
    detectors: dict[str, dict[str, Any]] = made["detectors"]
    for residual in ("speed", "balance"):
        if f"{residual}_drift" in detectors:
            detectors[f"{residual}_drift"]["period_s"] = FORMER_PERIOD_S
    made["detectors"] = {
        name: entry for name, entry in detectors.items() if name == "sensor" or entry.get("limit") is not None
    }
    return made


def _entries(calibration: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    for name, value in calibration.items():
        if name in ("speed", "balance") and isinstance(value, Mapping):
            for entry, of_residual in value.items():
                yield FORMER_RESIDUAL_NAMES.get(entry, f"{{residual}}.{entry}").format(residual=name), of_residual
        elif name != "format_version":
            yield FORMER_NAMES.get(name, name), value
