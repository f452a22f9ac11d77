"""Which fans the baseline has followed far: a notice, long before it is held at its limit."""

from __future__ import annotations

import numpy as np

from schemas.messages import Array
from scoring.baseline.baseline import Baseline
from scoring.detectors.alarm_units import AlarmUnits
from scoring.wear.slow_change import WEAR_HINT

FOLLOWED_FAR = 0.5
"""of its adaptation limit"""


def followed_fans(baseline: Baseline, limit_sigmas: float, sigma_rad_s: Array, units: AlarmUnits) -> list[str]:
    """A line for each fan whose baseline of the speed has moved far since commissioning, in tenths of its limit.

    limit_sigmas: of adaptation. sigma_rad_s: (fans,).
    """
    moved = np.where(baseline.is_set, baseline.value - baseline.commissioned, 0.0) / max(limit_sigmas, 1e-9)
    lines = []
    for fan in np.flatnonzero(np.abs(moved) >= FOLLOWED_FAR).tolist():
        share = f"{10 * int(10.0 * moved[fan]):+d} %"
        most = f"{units.shown_speed(limit_sigmas * sigma_rad_s[fan])} {units.speed}"
        lines.append(f"fan {fan}: the baseline of its speed has followed it by {share} of {most}: {WEAR_HINT}")
    return lines
