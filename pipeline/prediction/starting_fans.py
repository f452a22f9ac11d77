"""Fans that their command has stopped, and that have not settled since they were switched on again."""

from __future__ import annotations

import numpy as np

from fantwin.schemas.messages import Array
from fantwin.schemas.standstill import Standstill
from fantwin.schemas.units import NS_PER_S
from fantwin.scoring.column_state import NEVER_NS, ColumnState

START_TIME_CONSTANTS = 5.0  # of a fan that slows down: how long the start kick of its drive lasts


class StartingFans(ColumnState):
    """Start-up of the fans of one tray. Blocks are given in the order of their times."""

    def __init__(self, fans: int, standstill: Standstill, warm_up_ns: int, reach_s: float) -> None:
        """warm_up_ns: the least time after a stop. reach_s: how far back the tachos look."""
        start_s = (standstill.start_s or 0.0) + reach_s
        settling_s = START_TIME_CONSTANTS * (standstill.coast_time_constant_s or 0.0)
        self._start_up_ns = max(warm_up_ns, round((start_s + settling_s) * NS_PER_S))
        self._starting = np.zeros(fans, np.bool_)
        """(fans,) stopped by the command before, and no free run has settled since"""
        self._stopped_t_ns = np.full(fans, NEVER_NS)
        """(fans,) time when the command stopped the fan last"""

    def columns(self) -> dict[str, Array]:
        """See ColumnState."""
        return {"starting": self._starting, "stopped_t_ns": self._stopped_t_ns}

    def has_started_up(self, t_ns: Array, stopped: Array) -> Array:
        """Return where the last stop is so long ago that a start would be over, (n, fans). t_ns: (n,). stopped: (n,
        fans)."""
        last = np.maximum.accumulate(np.where(stopped, t_ns[:, np.newaxis], NEVER_NS), axis=0)
        last = np.maximum(last, self._stopped_t_ns)
        self._stopped_t_ns = last[-1].copy()
        started_up: Array = t_ns[:, np.newaxis] - last >= self._start_up_ns
        return started_up

    def is_starting(self, stopped: Array, warm: Array) -> Array:
        """Return where no free run has become warm since the command stopped the fan, (n, fans). Both (n, fans)."""
        row = np.arange(1, len(stopped) + 1)[:, np.newaxis]
        last_stopped = np.maximum.accumulate(np.where(stopped, row, 0), axis=0)
        last_warm = np.maximum.accumulate(np.where(warm, row, 0), axis=0)
        starting: Array = np.where((last_stopped == 0) & (last_warm == 0), self._starting, last_stopped > last_warm)
        self._starting = starting[-1].copy()
        return starting
