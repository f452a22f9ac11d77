"""What a measured supply voltage says of the cause: whether a fan that stands, or slows down, has power at all.

The voltage of the last second is compared with the highest median of a second before, in the window. The voltage is
measured where the drive is supplied; a plug between there and the fan may still be off.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from scoring.diagnosis.regression_window import Array, Window
from scoring.diagnosis.shown_causes import NO_POWER

RECENT_S = 1.0
LOST_BELOW, THERE_ABOVE = 0.5, 0.8
"""shares of the voltage before: power is lost below the one, and there above the other"""
NOT_OF_POWER = 0.02
"""relative likelihood of every other cause where the voltage is gone"""
PLUG_IS_OFF = 0.1
"""that of no power where the voltage is there"""


def weighed_by_supply(weights: Mapping[str, float], window: Window) -> dict[str, float]:
    """The weights of causes, with what the supply voltage says; unchanged where it is not known."""
    now_v, before_v = _now_and_before(window)
    if now_v < LOST_BELOW * before_v:
        return {cause: weight * (1.0 if cause == NO_POWER else NOT_OF_POWER) for cause, weight in weights.items()}
    if now_v > THERE_ABOVE * before_v:
        return {cause: weight * (PLUG_IS_OFF if cause == NO_POWER else 1.0) for cause, weight in weights.items()}
    return dict(weights)


def supply_in_words(window: Window) -> str:
    """The voltage now, as an addition to a sentence; empty where it is not known."""
    now_v, before_v = _now_and_before(window)
    if not math.isfinite(now_v + before_v):
        return ""
    if now_v > THERE_ABOVE * before_v:
        return f"; its supply has {now_v:.3g} V"
    return f"; its supply has {now_v:.3g} V and had {before_v:.3g} V"


def _now_and_before(window: Window) -> tuple[float, float]:
    """The voltage of the last second and the highest of the seconds before; NaN where one is not known."""
    voltage: Array | None = window.supply_voltage_v
    rows = max(1, round(RECENT_S / window.period_s))
    if voltage is None or len(voltage) < 2 * rows:
        return math.nan, math.nan
    seconds = voltage[len(voltage) % rows :].reshape(-1, rows)
    known = np.isfinite(seconds).any(axis=1)
    medians = np.full(len(seconds), np.nan)
    medians[known] = np.nanmedian(seconds[known], axis=1)
    before = medians[:-1]
    return float(medians[-1]), float(np.nanmax(before)) if np.isfinite(before).any() else math.nan
