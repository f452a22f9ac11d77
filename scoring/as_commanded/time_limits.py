"""Limits in s on starts, coasts and lapses of a healthy fan, from the twin's card; and how long conditions last."""

from __future__ import annotations

import numpy as np

from fantwin.schemas.messages import Array
from fantwin.schemas.standstill import Standstill


class Durations:
    """Durations over blocks of samples, each of which lasts one period. Samples that are not valid change nothing."""

    def __init__(self, valid: Array, period_ns: int) -> None:
        self.valid = valid
        self.period_ns = period_ns

    def of(self, grows: Array, ends: Array, before_ns: Array) -> Array:
        """Durations, ns, (..., n, fans): they grow with samples of `grows` and begin again with those of `ends`, both
        as many.

        before_ns: (..., fans) after the last block, and after this one when it returns.
        """
        grown: Array = (grows & self.valid).cumsum(axis=-2) * self.period_ns
        ended = ends & self.valid
        at_end = np.maximum.accumulate(np.where(ended, grown, 0), axis=-2)
        has_ended = np.logical_or.accumulate(ended, axis=-2)
        duration = grown - at_end + np.where(has_ended, 0, before_ns[..., np.newaxis, :])
        before_ns[:] = duration[..., -1, :]
        return duration


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
