"""The figures of a twin as commands print them, in the unit of the recordings."""

from __future__ import annotations

from typing import Any

FOUR_DIGITS = ".4g"
UNREASONABLY_LARGE = 1e7
"""Numbers from here on are shown with an exponent: such an error means that something went wrong."""


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


def closed_loop_sentence(fans: str) -> str:
    """One line on fans whose command answers their speed."""
    return (
        f"closed loop: the command of {fans} answers the measured speed, so a fault shows in the command and hardly in "
        "the speed; alarms compare the two"
    )
