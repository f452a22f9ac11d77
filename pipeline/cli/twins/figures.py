"""The figures of a twin as commands print them: as JSON and as text, in the unit of the recordings."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from fantwin.twin.evaluation.accuracy import Figures

FOUR_DIGITS = ".4g"
UNREASONABLY_LARGE = 1e7
"""Numbers from here on are shown with an exponent: such an error means that something went wrong."""


def figures_in(figures: Figures, rad_s_per_unit: float) -> dict[str, float | int | None]:
    """Figures with speeds in the given unit; None where a figure is undefined or infinite."""
    values = {
        "rmse": figures.rmse_rad_s / rad_s_per_unit,
        "max_error": figures.max_error_rad_s / rad_s_per_unit,
        "r2": figures.r2,
        "one_step_rmse": figures.one_step_rmse_rad_s / rad_s_per_unit,
        "coverage_2_sigma": figures.coverage_2_sigma,
        "tacho_floor": figures.floor_rad_s / rad_s_per_unit,
    }
    return {name: value if math.isfinite(value) else None for name, value in values.items()} | {
        "samples": figures.samples
    }


def shown(value: float | None, form: str = FOUR_DIGITS, undefined: str = "undefined") -> str:
    """A figure as text. Integers of more than four digits keep all their digits."""
    if value is None:
        return undefined
    if abs(value) >= UNREASONABLY_LARGE:
        return f"{value:.3g}"
    return f"{value:.0f}" if form == FOUR_DIGITS and abs(value) >= 1e3 else format(value, form)


def sentence(figures: dict[str, Any], unit: str) -> str:
    """Figures in one line."""
    text = {name: shown(figures[name]) for name in ("rmse", "max_error", "one_step_rmse")}
    floor = f" (a perfect model: {shown(figures['tacho_floor'])} by the tacho alone)" if figures["tacho_floor"] else ""
    return (
        f"free run: rmse {text['rmse']} {unit}{floor}, max error {text['max_error']} {unit}, "
        f"R2 {shown(figures['r2'], '.4f')}, {shown(figures['coverage_2_sigma'], '.1%')} within 2 sigma; "
        f"one step: rmse {text['one_step_rmse']} {unit}; {figures['samples']} samples"
    )
