"""A fan that turns although its command stops it.

A healthy fan coasts, and then stands. What coasts look like is in the twin's card (schemas.standstill). A fan runs on

- if it turns for three times the longest coast;
- if it does not slow down: its reading is above that of a coast three times as slow as usual, which begins at its
  highest reading soon after the command, and above 70 % of that reading;
- if it turns after it has been at rest.

Readings lag, so what is seen within the reach of the tacho and `MIN_MOVE_S` is not judged.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from pydantic import Field

from schemas.messages import Alarm, Array
from schemas.standstill import Standstill
from schemas.units import NS_PER_S
from scoring.detectors.alarm_units import AlarmUnits
from scoring.detectors.detector import Detector, DetectorContext, DetectorInput, DetectorSettings, LimitRule, Signal
from scoring.detectors.durations import Durations

MARGIN = 3.0  # times the longest or the usual of healthy runs
MIN_MOVE_S = 1.0  # and the reach of the tacho: the shortest limit of a start or a coast; training shows few of them
LEAST_FALL = 0.7  # of the highest reading: a coast is judged below it
CERTAIN = 2.0  # ratios above 1 are multiplied by it: a fan that does not do as commanded is an alarm, not a warning
OFF_DELAY_S = 2.0
PEAK_STEPS = 64.0  # of a rad/s: with the next, sums that do not depend on how samples are cut into blocks
BEYOND_SPEEDS_RAD_S = 2.0**20


class RunningOnSettings(DetectorSettings):
    """From the card of the twin."""

    rule: ClassVar[LimitRule] = LimitRule.GIVEN
    healthy: Standstill = Field(description="how healthy fans stop, stand and start")
    factor: float = Field(default=1.0, gt=0, description="multiplies the times")
    by_coast_only: bool = Field(
        default=False, description="whether only the first of the three counts, as in earlier recordings"
    )

    @classmethod
    def unreached(cls) -> RunningOnSettings:
        """Calibration does not set it."""
        raise NotImplementedError("the settings are those of the twin's card")

    def scaled(self, factor: float) -> RunningOnSettings:
        """See DetectorSettings."""
        return self.model_copy(update={"factor": self.factor * factor})


class RunningOn(Detector):
    """How long a fan has turned although it is stopped, in multiples of what is healthy; NaN unless it is stopped."""

    settings = RunningOnSettings

    def __init__(self, settings: RunningOnSettings, context: DetectorContext) -> None:
        self._healthy = healthy = settings.healthy
        reach_s = np.array([tacho.reach_s for tacho in context.tachos])
        lag_s = MIN_MOVE_S + reach_s
        self._lag_s = settings.factor * lag_s
        self._memory_s = settings.factor * np.maximum(MARGIN * (healthy.start_s or 0.0), lag_s)
        coast_limit_s = np.maximum(MARGIN * (healthy.coast_s or 0.0), lag_s)
        self._coast_limit_s = settings.factor * coast_limit_s if healthy.coast_s is not None else np.inf + reach_s
        self._by_coast_only = settings.by_coast_only
        constant_s = healthy.coast_time_constant_s
        self._time_constant_s = np.inf if constant_s is None else settings.factor * MARGIN * constant_s
        self._lasted_ns = np.zeros((4, context.fans), np.int64)
        """for how long the fan has turned although it is stopped, has been stopped, at rest, and at rest for the lag"""
        self._peak_rad_s = np.zeros(context.fans)
        """highest reading within the lag since the command stopped it"""

    def update(self, block: DetectorInput) -> Array:
        """See Detector."""
        ratio, speed = self.ratio(block), block.speed_rad_s
        obeys = self._healthy.stops(block.command, speed) & np.isfinite(speed) & ~self._healthy.turns(speed)
        return np.where(ratio > 1.0, CERTAIN * ratio, np.where(obeys, 0.0, np.nan))

    def ratio(self, block: DetectorInput) -> Array:
        """(n, fans) how long each has run on, in multiples of its limit: 0 where it does not."""
        speed = block.speed_rad_s
        stops, known, turns = self._healthy.stops(block.command, speed), np.isfinite(speed), self._healthy.turns(speed)
        count = Durations(block.valid, block.period_ns)
        ran_on = count.of(stops & turns, ~stops | (known & ~turns), self._lasted_ns[0])
        if self._by_coast_only:
            return ran_on / NS_PER_S / self._coast_limit_s
        stopped = count.of(stops, ~stops, self._lasted_ns[1])
        at_rest = count.of(stops & ~turns, ~stops | turns, self._lasted_ns[2])
        lag_ns = self._lag_s * NS_PER_S
        rested = count.of(stops & (at_rest >= lag_ns), ~stops, self._lasted_ns[3])
        is_first = turns & block.valid & (stopped <= lag_ns)
        peak = self._peaks(np.where(is_first, np.abs(speed), 0.0), ~stops & block.valid)
        slowed = np.divide(np.abs(speed), peak, out=np.ones_like(peak), where=turns & (peak > 0.0))
        coast_s = self._lag_s - self._time_constant_s * np.log(np.clip(slowed, 1e-9, LEAST_FALL))
        limit_s = np.where(rested > 0, self._lag_s, np.minimum(self._coast_limit_s, coast_s))
        return ran_on / NS_PER_S / limit_s

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
        self._peak_rad_s[fans] = 0.0

    @property
    def memory_s(self) -> float:
        """After a longer gap the fan may have been started and stopped again."""
        return float(np.max(self._memory_s))

    @property
    def off_delay_s(self) -> float:
        """See Detector."""
        return OFF_DELAY_S

    def columns(self) -> dict[str, Array]:
        """See ColumnState."""
        names = ("ran_on_ns", "stopped_ns", "at_rest_ns", "rested_ns")
        return {**dict(zip(names, self._lasted_ns, strict=True)), "peak_rad_s": self._peak_rad_s}

    def restore(self, state: Mapping[str, Any]) -> None:
        """See ColumnState. Snapshots of former versions know how long it has run on, and nothing else."""
        super().restore({**self.snapshot(), **state})

    @classmethod
    def text(cls, alarm: Alarm, source: Signal, units: AlarmUnits) -> str:
        """See Detector. What it does against which command is the evidence of the first cause."""
        return (alarm.causes[0].evidence if alarm.causes else "") or "turns although its command stops it"
