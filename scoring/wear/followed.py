"""Which fans the baseline has followed far, and what all share: notices, long before a limit is reached."""

from __future__ import annotations

import numpy as np

from schemas.messages import Array
from scoring.baseline.baseline import Baseline
from scoring.detectors.alarm_units import AlarmUnits
from scoring.wear.slow_change import MOST_FANS, WEAR_HINT

FOLLOWED_FAR = 0.5
"""of its adaptation limit"""
SHARED_FAR = 0.75
"""of its limit; the air of a room and a supply make up half of it by themselves"""


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


def shared_by_all(share: float, limit: float) -> list[str]:
    """A line where most fans of a tray have changed alike by this share of their speed, in tenths of its limit."""
    if not limit or abs(share) < SHARED_FAR * limit:
        return []
    shown = 10.0 * limit * int(10.0 * abs(share) / limit)
    direction = "slower" if share < 0.0 else "faster"
    return [
        f"{MOST_FANS} {shown:.1f} % {direction} than when they were commissioned: the air, the supply, or a "
        f"filter in front of them all; beyond {100 * limit:.1f} % every fan raises an alarm"
    ]
