"""The tacho itself: readings that repeat themselves, and readings that are missing.

A stuck tacho goes on to give the last value. A healthy one may do so as well, for a while, where it counts coarsely
and the fan runs evenly; calibration says for how long. What is missing is judged by its share.
"""

from __future__ import annotations

import numpy as np

from schemas.messages import Array
from scoring.detectors.low_pass import LowPass

MISSING_TIME_CONSTANT_S = 2.0


class Sensor:
    """The tachos of a tray's fans."""

    def __init__(self, fans: int, stuck_limit_s: float, missing_limit: float) -> None:
        """stuck_limit_s: for how long a reading may repeat itself. missing_limit: the share that may be missing."""
        self._stuck_limit_s = stuck_limit_s
        self._missing_limit = missing_limit
        self.last = np.full(fans, np.nan)
        """(fans,) rad/s, the last reading"""
        self.since_ns = np.zeros(fans, np.int64)
        """(fans,) for how long it has repeated itself"""
        self.missing = LowPass(fans, MISSING_TIME_CONSTANT_S)
        self.longest_s = 0.0
        """for how long any reading has repeated itself so far"""
        self.most_missing = 0.0
        """the largest share so far"""

    def reset(self, fans: Array) -> None:
        """Begin anew for some fans, (fans,) of bool."""
        self.since_ns[fans] = 0
        self.missing.reset(fans)

    def stuck_s(self, speed_rad_s: Array, period_ns: int) -> Array:
        """For how long each reading has repeated itself, s. speed_rad_s: (n, fans), NaN where there is none.

        A fan at rest reads zero and is not stuck.
        """
        before = np.vstack((self.last, speed_rad_s))[:-1]
        same = (speed_rad_s == before) & (speed_rad_s != 0.0)
        rows = np.arange(1, len(speed_rad_s) + 1)[:, np.newaxis]
        broken = np.maximum.accumulate(np.where(same, 0, rows), axis=0)
        lasted_ns = (rows - broken) * period_ns + np.where(broken == 0, self.since_ns, 0)
        self.last, self.since_ns = speed_rad_s[-1].copy(), lasted_ns[-1].copy()
        return lasted_ns / 1e9

    def update(self, speed_rad_s: Array, missing: Array, alive: Array, period_ns: int) -> Array:
        """Take a block, (n, fans) each: readings, where one is missing, and where the line gave any at all.

        Returns the larger of the two in its own limit.
        """
        known = alive & np.isfinite(speed_rad_s)
        stuck_s = self.stuck_s(np.where(known, speed_rad_s, np.nan), period_ns)
        share = self.missing.update(missing.astype(np.float64), alive, period_ns / 1e9)
        self.longest_s = max(self.longest_s, float(stuck_s.max()))
        self.most_missing = max(self.most_missing, float(share.max()))
        return np.maximum(stuck_s / self._stuck_limit_s, share / self._missing_limit)
