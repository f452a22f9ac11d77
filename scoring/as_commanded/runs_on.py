"""A fan that turns although its command stops it.

A healthy fan coasts, and then stands. What coasts look like is in the twin's card (schemas.standstill). A fan runs on

- if it turns for three times the longest coast;
- if it keeps its speed: its reading stays above 70 % of the highest one soon after the command, for three times the
  longest time in which a coasting fan lost 30 %;
- if it turns after it has been at rest.

Readings lag, so what is seen within the reach of the tacho and a second is not judged.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fantwin.schemas.messages import Array
from fantwin.schemas.standstill import SLOWED_SHARE, Standstill
from fantwin.schemas.tacho import Tacho
from fantwin.schemas.units import NS_PER_S
from fantwin.scoring.as_commanded.time_limits import Durations, coast_limit_s, lag_s, slowing_limit_s
from fantwin.scoring.diagnosis.standstill_causes import Standing
from fantwin.scoring.saved import Saved

PEAK_STEPS = 64.0  # in a rad/s: peaks are rounded, so that sums with the next are exact, however blocks are cut
BEYOND_SPEEDS_RAD_S = 2.0**20
LONG_AGO_NS = 1 << 60  # age of a stop that was not observed: the speed at its beginning is not known
KINDS = (Standing.TURNED_AGAIN, Standing.KEEPS_SPEED, Standing.COASTS_TOO_LONG)


class RunsOn(Saved):
    """Time for which each fan has turned although it is stopped."""

    KEPT = ("_lasted_ns", "_peak_rad_s")

    def __init__(self, healthy: Standstill, tachos: Sequence[Tacho]) -> None:
        """Begin without knowledge of the fans. tachos: of each fan."""
        self._healthy = healthy
        reach_s = np.array([tacho.reach_s for tacho in tachos])
        self._lag_s = lag_s(reach_s)
        self._coast_limit_s = coast_limit_s(healthy, reach_s)
        self._slowing_limit_s = np.minimum(slowing_limit_s(healthy, reach_s), self._coast_limit_s)
        self._lasted_ns = np.zeros((4, len(tachos)), np.int64)
        """(4, fans) time for which each has turned although stopped, been stopped, at rest, and at rest for the lag"""
        self._lasted_ns[1] = LONG_AGO_NS
        self._peak_rad_s = np.zeros(len(tachos))
        """highest reading within the lag since the command stopped it; 0 if there is none"""

    def update(self, command: Array, speed_rad_s: Array, counts: Durations) -> tuple[Array, Array, Array]:
        """Return the time in multiples of a healthy one, 0 where a fan does not run on; where a fan stands as it
        should; and the number of the kind in KINDS. All (n, fans), also command and speed_rad_s."""
        stops, turns = self._healthy.stops(command, speed_rad_s), self._healthy.turns(speed_rad_s)
        stands = np.isfinite(speed_rad_s) & ~turns
        ran_on = counts.of(stops & turns, ~stops | stands, self._lasted_ns[0])
        lag_ns = self._lag_s * NS_PER_S
        stopped = counts.of(stops, ~stops, self._lasted_ns[1])
        at_rest = counts.of(stops & stands, ~stops | turns, self._lasted_ns[2])
        rested = counts.of(stops & (at_rest >= lag_ns), ~stops, self._lasted_ns[3])
        is_first = turns & counts.valid & (stopped <= lag_ns)
        peak = self._peaks(np.where(is_first, np.abs(speed_rad_s), 0.0), ~stops & counts.valid)
        keeps_speed = turns & (peak > 0.0) & (np.nan_to_num(np.abs(speed_rad_s)) > SLOWED_SHARE * peak)
        limit_s = np.where(keeps_speed, self._slowing_limit_s, self._coast_limit_s)
        ratio = ran_on / np.where(rested > 0, self._lag_s, limit_s) / NS_PER_S
        return ratio, stops & stands, np.where(rested > 0, 0, np.where(keeps_speed, 1, 2))

    def _peaks(self, readings: Array, ends: Array) -> Array:
        """Return the highest of the readings since the last end, (n, fans)."""
        since = ends.cumsum(axis=0) * BEYOND_SPEEDS_RAD_S  # so that a reading after an end is above all before it
        offset = np.vstack((self._peak_rad_s, np.round(readings * PEAK_STEPS) / PEAK_STEPS + since))
        peaks = np.maximum(np.maximum.accumulate(offset, axis=0)[1:] - since, 0.0)
        self._peak_rad_s[:] = peaks[-1]
        return peaks

    def forget(self, fans: Array) -> None:
        """Begin again for some fans, (fans,) of bool."""
        self._lasted_ns[:, fans] = 0
        self._lasted_ns[1, fans] = LONG_AGO_NS
        self._peak_rad_s[fans] = 0.0
