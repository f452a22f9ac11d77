"""Whether a fan changes its speed during an interval: such an interval says little about the offset of the fan.

The residual of a fan that speeds up contains the errors of the twin's inertia and of the tacho's delay. The measure is
the mean distance of the speed from its low-pass over one second (scoring.detectors.motion), with its sign, so that the
noise of the tacho averages out, relative to the mean speed.
"""

from __future__ import annotations

import numpy as np

from schemas.messages import Array
from scoring.baseline.intervals import Intervals
from scoring.column_state import ColumnState

MOVING_SHARE = 0.05  # of the speed
MAX_MOVING_INTERVALS = 60  # of commissioning, after which they count like others: some fans always move
FIXED_POINT_ONE = 1 << 20  # one rad/s; integer sums do not depend on how samples are cut
LARGEST_RAD_S = 1e6  # larger values are clipped to this


class Movement(ColumnState):
    """The movement of a tray's fans in the present interval."""

    def __init__(self, fans: int) -> None:
        self._motions = np.zeros(fans, np.int64)
        self._speeds = np.zeros(fans, np.int64)
        self._moving_intervals = np.zeros(fans, np.int64)

    @staticmethod
    def samples(motion_rad_s: Array, speed_rad_s: Array) -> Array:
        """(2, n, fans) of samples (n, fans), to be added; speeds may be NaN, where the motion is 0."""
        speed_rad_s = np.where(np.isnan(speed_rad_s), 0.0, np.abs(speed_rad_s))
        return _fixed(np.array((motion_rad_s, speed_rad_s)))

    def over(self, samples: Array, intervals: Intervals) -> Array:
        """(2, intervals, fans) sums of samples, see `samples`, of the present interval and later ones."""
        sums = intervals.sums(samples.swapaxes(0, 1)).swapaxes(0, 1)
        sums[0, 0] += self._motions
        sums[1, 0] += self._speeds
        return sums

    def moving(self, sums: Array, commissioning: Array) -> Array:
        """(intervals, fans) what `end_interval` returns at the end of each. sums: see `over`."""
        moved = self._moved(*sums)
        before = np.concatenate((np.zeros((1, moved.shape[1]), np.int64), moved[:-1].cumsum(axis=0)))
        return moved & (self._moving_intervals + np.where(commissioning, before, 0) < MAX_MOVING_INTERVALS)

    def take(self, sums: Array, commissioning: Array) -> None:
        """Go on in the last of some intervals; commissioning: (fans,), see `end_interval`."""
        if sums.shape[1] > 1:
            counted = self.moving(sums, commissioning)[:-1].sum(axis=0)
            self._moving_intervals += np.where(commissioning, counted, 0)
        self._motions[:], self._speeds[:] = sums[:, -1]

    @staticmethod
    def _moved(motions: Array, speeds: Array) -> Array:
        return np.abs(motions) > MOVING_SHARE * speeds

    def end_interval(self, commissioning: Array) -> Array:
        """End the interval. Returns (fans,) whether fans are not to be commissioned from it, because they moved.

        commissioning: (fans,) whether fans are being commissioned.
        """
        moving = self._moved(self._motions, self._speeds)
        moving &= self._moving_intervals < MAX_MOVING_INTERVALS
        self._moving_intervals += moving & commissioning
        self._motions[:] = self._speeds[:] = 0
        return moving

    def restart(self, fans: Array) -> None:
        """Some fans, (fans,) of bool, are commissioned again."""
        self._moving_intervals[fans] = 0

    def columns(self) -> dict[str, Array]:
        """See ColumnState."""
        return {"motions": self._motions, "speeds": self._speeds, "moving_intervals": self._moving_intervals}


def _fixed(values: Array) -> Array:
    return np.rint(values.clip(-LARGEST_RAD_S, LARGEST_RAD_S) * FIXED_POINT_ONE).astype(np.int64)
