"""A fan that turns although its command stops it.

A healthy fan coasts, and then stands. What coasts look like is in the twin's card (schemas.standstill). A fan runs on

- if it turns for three times the longest coast;
- if it keeps its speed: its reading stays above 70 % of the highest one soon after the command, for three times the
  longest time in which a coasting fan lost 30 %;
- if it turns after it has been at rest.

Readings lag, so what is seen within the reach of the tacho and a second is not judged.
"""

from __future__ import annotations

import numpy as np

from schemas.messages import Alarm, Array
from schemas.standstill import SLOWED_SHARE
from schemas.units import NS_PER_S
from scoring.detectors.alarm_units import AlarmUnits
from scoring.detectors.detector import Detector, DetectorContext, DetectorInput, Signal
from scoring.detectors.durations import Durations
from scoring.detectors.healthy_times import HealthyTimes, coast_limit_s, lag_s, slowing_limit_s

CERTAIN = 2.0  # ratios above 1 are multiplied by it: a fan that does not do as commanded is an alarm, not a warning
OFF_DELAY_S = 2.0
PEAK_STEPS = 64.0  # in a rad/s: peaks are rounded, so that sums with the next are exact, however blocks are cut
BEYOND_SPEEDS_RAD_S = 2.0**20
LONG_AGO_NS = 1 << 60  # when a stop was that nobody has seen: the speed that it began with is not known


class RunningOnSettings(HealthyTimes):
    """From the card of the twin."""


class RunningOn(Detector):
    """How long a fan has turned although it is stopped, in multiples of what is healthy; NaN unless it is stopped."""

    settings = RunningOnSettings

    def __init__(self, settings: RunningOnSettings, context: DetectorContext) -> None:
        self._healthy = healthy = settings.healthy
        reach_s = np.array([tacho.reach_s for tacho in context.tachos])
        self._lag_s = settings.factor * lag_s(reach_s)
        self._coast_limit_s = settings.factor * coast_limit_s(healthy, reach_s)
        self._slowing_limit_s = np.minimum(settings.factor * slowing_limit_s(healthy, reach_s), self._coast_limit_s)
        self._lasted_ns = np.zeros((4, context.fans), np.int64)
        """for how long the fan has turned although it is stopped, has been stopped, at rest, and at rest for the lag"""
        self._lasted_ns[1] = LONG_AGO_NS
        self._peak_rad_s = np.zeros(context.fans)
        """highest reading within the lag since the command stopped it; 0 if there is none"""

    def update(self, block: DetectorInput) -> Array:
        """See Detector."""
        ratio, speed = self.ratio(block), block.speed_rad_s
        obeys = self._healthy.stops(block.command, speed) & np.isfinite(speed) & ~self._healthy.turns(speed)
        return np.where(ratio > 1.0, CERTAIN * ratio, np.where(obeys, 0.0, np.nan))

    def ratio(self, block: DetectorInput) -> Array:
        """(n, fans) how long each has run on, in multiples of its limit: 0 where it does not."""
        speed = block.speed_rad_s
        stops, turns = self._healthy.stops(block.command, speed), self._healthy.turns(speed)
        stands = np.isfinite(speed) & ~turns
        count = Durations(block.valid, block.period_ns)
        ran_on = count.of(stops & turns, ~stops | stands, self._lasted_ns[0])
        lag_ns = self._lag_s * NS_PER_S
        stopped = count.of(stops, ~stops, self._lasted_ns[1])
        at_rest = count.of(stops & stands, ~stops | turns, self._lasted_ns[2])
        rested = count.of(stops & (at_rest >= lag_ns), ~stops, self._lasted_ns[3])
        is_first = turns & block.valid & (stopped <= lag_ns)
        peak = self._peaks(np.where(is_first, np.abs(speed), 0.0), ~stops & block.valid)
        keeps_speed = turns & (peak > 0.0) & (np.nan_to_num(np.abs(speed)) > SLOWED_SHARE * peak)
        limit_s = np.where(keeps_speed, self._slowing_limit_s, self._coast_limit_s)
        return ran_on / np.where(rested > 0, self._lag_s, limit_s) / NS_PER_S

    def _peaks(self, readings: Array, ends: Array) -> Array:
        """(n, fans) the highest of the readings since the last end."""
        since = ends.cumsum(axis=0) * BEYOND_SPEEDS_RAD_S  # so that a reading after an end is above all before it
        offset = np.vstack((self._peak_rad_s, np.round(readings * PEAK_STEPS) / PEAK_STEPS + since))
        peaks = np.maximum(np.maximum.accumulate(offset, axis=0)[1:] - since, 0.0)
        self._peak_rad_s[:] = peaks[-1]
        return peaks

    def reset(self, fans: Array) -> None:
        """See Detector."""
        self._lasted_ns[:, fans] = 0
        self._lasted_ns[1, fans] = LONG_AGO_NS
        self._peak_rad_s[fans] = 0.0

    @property
    def memory_s(self) -> float:
        """In a gap the fan may have been started and stopped again."""
        return 0.0

    @property
    def off_delay_s(self) -> float:
        """See Detector."""
        return OFF_DELAY_S

    def columns(self) -> dict[str, Array]:
        """See ColumnState."""
        ran_on, stopped, at_rest, rested = self._lasted_ns
        times = {"ran_on_ns": ran_on, "stopped_ns": stopped, "at_rest_ns": at_rest, "rested_ns": rested}
        return {**times, "peak_rad_s": self._peak_rad_s}

    @classmethod
    def text(cls, alarm: Alarm, source: Signal, units: AlarmUnits) -> str:
        """See Detector. What it does against which command is the evidence of the first cause."""
        return (alarm.causes[0].evidence if alarm.causes else "") or "does not turn or stop as commanded"
