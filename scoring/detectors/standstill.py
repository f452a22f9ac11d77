"""A fan that stands although its command turns it.

It needs no prediction: what commands do to healthy fans, and how long starts and coasts take, is in the twin's card
(schemas.standstill). While a fan starts it may read as standing for three times the longest healthy start. Once it has
turned, only lapses of its tacho explain a reading of a fan that stands. A tacho that gives no reading may not be read
for its reach and `MISSING_S` more.

A fan that turns although its command stops it has a detector of its own (scoring.detectors.running_on), so that an
alarm returns by what could show its fault: each has no ratio (NaN) where the fan could not show that it does as
commanded.
"""

from __future__ import annotations

import numpy as np

from schemas.messages import Alarm, Array
from schemas.units import NS_PER_S
from scoring.detectors.alarm_units import AlarmUnits
from scoring.detectors.detector import Detector, DetectorContext, DetectorInput, Signal
from scoring.detectors.durations import Durations
from scoring.detectors.healthy_times import HealthyTimes, lapse_limit_s, start_limit_s
from scoring.detectors.running_on import CERTAIN, OFF_DELAY_S, RunningOn

MISSING_S = 2.0  # beyond the reach of the tacho
UNKNOWN_STARTED_S = 5.0  # beyond the reach: the length of a start, if none was seen


class StandstillSettings(HealthyTimes):
    """From the card of the twin."""


class StandstillDetector(Detector):
    """How long a fan has stood or given no reading against its command, in multiples of what is healthy."""

    settings = StandstillSettings

    def __init__(self, settings: StandstillSettings, context: DetectorContext) -> None:
        self._healthy = healthy = settings.healthy
        reach_s = np.array([tacho.reach_s for tacho in context.tachos])
        started_s = UNKNOWN_STARTED_S + reach_s if healthy.start_s is None else healthy.start_s
        self._started_ns = started_s * NS_PER_S
        self._lapse_limit_s = settings.factor * lapse_limit_s(healthy)
        self._start_limit_s = settings.factor * start_limit_s(healthy, reach_s)
        self._missing_limit_s: Array = settings.factor * (reach_s + MISSING_S)
        self._lasted_ns = np.zeros((4, context.fans), np.int64)
        """for how long the fan has been driven, turned, stood, and given no reading"""

    def update(self, block: DetectorInput) -> Array:
        """See Detector."""
        healthy, speed = self._healthy, block.speed_rad_s
        drives, known, turns = healthy.drives(block.command), np.isfinite(speed), healthy.turns(speed)
        count = Durations(block.valid, block.period_ns)
        driven = count.of(drives, ~drives, self._lasted_ns[0])
        turned, stood, silent = count.of(
            np.array((drives & turns & (driven >= self._started_ns), drives & known & ~turns, drives & ~known)),
            np.array((~drives, ~drives | turns, ~drives | known)),
            self._lasted_ns[1:],
        )
        limit_s = np.where(turned > 0, self._lapse_limit_s, self._start_limit_s)
        ratio = np.maximum(stood / limit_s, silent / self._missing_limit_s) / NS_PER_S
        return np.where(ratio > 1.0, CERTAIN * ratio, np.where(drives & turns, 0.0, np.nan))

    def reset(self, fans: Array) -> None:
        """See Detector."""
        self._lasted_ns[:, fans] = 0

    @property
    def memory_s(self) -> float:
        """After a longer gap nothing is known about how the fan was started."""
        return float(np.max(self._start_limit_s))

    @property
    def off_delay_s(self) -> float:
        """See Detector."""
        return OFF_DELAY_S

    def columns(self) -> dict[str, Array]:
        """See ColumnState."""
        names = ("driven_ns", "turned_ns", "stood_ns", "silent_ns")
        return dict(zip(names, self._lasted_ns, strict=True))

    @classmethod
    def text(cls, alarm: Alarm, source: Signal, units: AlarmUnits) -> str:
        """See Detector."""
        return RunningOn.text(alarm, source, units)
