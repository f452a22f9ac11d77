"""Limits in s on starts, coasts and lapses of a healthy fan, from the twin's card."""

from __future__ import annotations

import numpy as np

from fantwin.schemas.messages import Array
from fantwin.schemas.standstill import Standstill

MARGIN = 3.0  # times the longest of healthy runs
MIN_LAPSE_S = 0.5
MIN_MOVE_S = 1.0  # and the reach of the tacho: the shortest limit of a start or a coast; training shows few of them
UNKNOWN_START_S = 30.0  # beyond the reach, if no start was seen


def lag_s(reach_s: Array) -> Array:
    """Longest time, s, until readings show the effect of a command, (fans,)."""
    return MIN_MOVE_S + reach_s


def lapse_limit_s(healthy: Standstill) -> float:
    """Longest time, s, for which the tacho of a fan that turns may read as if it stood."""
    return max(MIN_LAPSE_S, MARGIN * healthy.lapse_s)


def start_limit_s(healthy: Standstill, reach_s: Array) -> Array:
    """Longest time, s, for which a fan may stand after a command that turns it, (fans,)."""
    limit_s = UNKNOWN_START_S + reach_s
    if healthy.start_s is not None:
        limit_s = np.maximum(MARGIN * healthy.start_s, lag_s(reach_s))
    return np.maximum(limit_s, lapse_limit_s(healthy))


def coast_limit_s(healthy: Standstill, reach_s: Array) -> Array:
    """Longest time, s, for which a fan may turn after a command that stops it, (fans,); infinite if unknown."""
    if healthy.coast_s is None:
        return np.inf + reach_s
    return np.maximum(MARGIN * healthy.coast_s, lag_s(reach_s))


def slowing_limit_s(healthy: Standstill, reach_s: Array) -> Array:
    """Longest time, s, for which readings may show that it keeps its speed then, (fans,); infinite if unknown."""
    slowing_s = np.inf if healthy.slowing_s is None else max(MARGIN * healthy.slowing_s, MIN_MOVE_S)
    return slowing_s + reach_s
