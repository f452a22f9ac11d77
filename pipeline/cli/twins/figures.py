"""The figures of a twin as commands tell them: for machines, and for people in their own units."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from twin.evaluation.accuracy import Figures

FOUR_DIGITS = ".4g"
BEYOND_REASON = 1e7
"""From here on a number says only that something went wrong, and is shown with an exponent."""


def figures_in(figures: Figures, rad_s_per_unit: float) -> dict[str, float | int | None]:
    """Figures for people and machines: speeds in a unit of theirs, None where a figure is undefined or infinite."""
    values = {
        "rmse": figures.rmse_rad_s / rad_s_per_unit,
        "max_error": figures.max_error_rad_s / rad_s_per_unit,
        "r2": figures.r2,
        "one_step_rmse": figures.one_step_rmse_rad_s / rad_s_per_unit,
        "coverage_2_sigma": figures.coverage_2_sigma,
    }
    return {name: value if math.isfinite(value) else None for name, value in values.items()} | {
        "samples": figures.samples
    }


def shown(value: float | None, form: str = FOUR_DIGITS, undefined: str = "undefined") -> str:
    """A figure for people. Four digits do not cut a large number short."""
    if value is None:
        return undefined
    if abs(value) >= BEYOND_REASON:
        return f"{value:.3g}"
    return f"{value:.0f}" if form == FOUR_DIGITS and abs(value) >= 1e3 else format(value, form)


def sentence(figures: dict[str, Any], unit: str) -> str:
    """Figures in a line."""
    said = {name: shown(figures[name]) for name in ("rmse", "max_error", "one_step_rmse")}
    return (
        f"free run: rmse {said['rmse']} {unit}, max error {said['max_error']} {unit}, "
        f"R2 {shown(figures['r2'], '.4f')}, {shown(figures['coverage_2_sigma'], '.1%')} within 2 sigma; "
        f"one step: rmse {said['one_step_rmse']} {unit}; {figures['samples']} samples"
    )
