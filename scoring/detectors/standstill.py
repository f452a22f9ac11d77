"""A fan that stands although its command turns it, or turns although its command stops it.

It needs no prediction: what commands do to healthy fans, and how long starts and coasts take, is in the twin's card
(schemas.standstill). While a fan starts it may read as standing for three times the longest healthy start. Once it has
turned, only lapses of its tacho explain a reading of a fan that stands. A tacho that gives no reading may not be read
for its reach and `MISSING_S` more.

There are two detectors, of fans that are driven and of fans that are stopped, so that an alarm returns by what could
show its fault: each has no ratio (NaN) where the fan could not show that it does as commanded.
"""

from __future__ import annotations

from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from schemas.messages import Alarm, Array
from schemas.standstill import Standstill
from schemas.units import NS_PER_S
from scoring.detectors.alarm_units import AlarmUnits
from scoring.detectors.detector import Detector, DetectorContext, DetectorInput, DetectorSettings, LimitRule, Signal

MARGIN = 3.0  # times the longest of healthy runs
MIN_LAPSE_S = 0.5
MIN_MOVE_S = 1.0  # and the reach of the tacho: the shortest limit of a start or a coast; training shows few of them
MISSING_S = 2.0  # beyond the reach of the tacho
UNKNOWN_START_S, UNKNOWN_STARTED_S = 30.0, 5.0  # beyond the reach, if no start was seen: its limit, and its length
CERTAIN = 2.0  # ratios above 1 are multiplied by it: a fan that does not turn is an alarm, not a warning
OFF_DELAY_S = 2.0


class StandstillSettings(DetectorSettings):
    """From the card of the twin."""

    rule: ClassVar[LimitRule] = LimitRule.GIVEN
    healthy: Standstill = Field(description="how healthy fans stop, stand and start")
    factor: float = Field(default=1.0, gt=0, description="multiplies the times")
    watches: Literal["driven", "stopped", "both"] = Field(
        default="driven",
        description="fans that are driven or stopped; both: with a ratio everywhere, as in earlier recordings",
    )

    @classmethod
    def unreached(cls) -> StandstillSettings:
        """Calibration does not set it."""
        raise NotImplementedError("the settings are those of the twin's card")

    def scaled(self, factor: float) -> StandstillSettings:
        """See DetectorSettings."""
        return self.model_copy(update={"factor": self.factor * factor})


class StandstillDetector(Detector):
    """How long a fan has stood, turned or given no reading against its command, in multiples of what is healthy."""

    settings = StandstillSettings

    def __init__(self, settings: StandstillSettings, context: DetectorContext) -> None:
        self._healthy = healthy = settings.healthy
        self._watches = settings.watches
        reach_s = np.array([tacho.reach_s for tacho in context.tachos])
        known_start = healthy.start_s is not None
        least_s = MIN_MOVE_S + reach_s
        start_limit_s = np.maximum(MARGIN * (healthy.start_s or 0.0), least_s)
        start_limit_s = start_limit_s if known_start else UNKNOWN_START_S + reach_s
        self._started_ns = ((healthy.start_s or 0.0) if known_start else UNKNOWN_STARTED_S + reach_s) * NS_PER_S
        lapse_limit_s = max(MIN_LAPSE_S, MARGIN * healthy.lapse_s)
        self._lapse_limit_s = settings.factor * lapse_limit_s
        self._start_limit_s = settings.factor * np.maximum(start_limit_s, lapse_limit_s)
        self._missing_limit_s: Array = settings.factor * (reach_s + MISSING_S)
        coast_limit_s = np.maximum(MARGIN * (healthy.coast_s or 0.0), least_s)
        self._coast_limit_s = settings.factor * coast_limit_s if healthy.coast_s is not None else np.inf + reach_s
        self._lasted_ns = np.zeros((5, context.fans), np.int64)
        """for how long the fan has been driven, turned, stood, given no reading, and turned although it is stopped"""

    def update(self, block: DetectorInput) -> Array:
        """See Detector."""
        healthy, valid, speed = self._healthy, block.valid, block.speed_rad_s
        drives, stops = healthy.drives(block.command), healthy.stops(block.command, speed)
        known, turns = np.isfinite(speed), healthy.turns(speed)
        count = _Durations(valid, block.period_ns)
        driven = count.of(drives, ~drives, self._lasted_ns[0])
        turned, stood, silent, ran_on = count.of(
            np.array(
                (
                    drives & turns & (driven >= self._started_ns),
                    drives & known & ~turns,
                    drives & ~known,
                    stops & turns,
                )
            ),
            np.array((~drives, ~drives | turns, ~drives | known, ~stops | (known & ~turns))),
            self._lasted_ns[1:],
        )
        limit_s = np.where(turned > 0, self._lapse_limit_s, self._start_limit_s)
        of_driven = np.maximum(stood / limit_s, silent / self._missing_limit_s) / NS_PER_S
        of_stopped = ran_on / self._coast_limit_s / NS_PER_S
        if self._watches == "both":
            ratio = np.maximum(of_driven, of_stopped)
            return np.where(ratio > 1.0, CERTAIN * ratio, ratio)
        ratio, obeys = (
            (of_driven, drives & turns) if self._watches == "driven" else (of_stopped, stops & known & ~turns)
        )
        return np.where(ratio > 1.0, CERTAIN * ratio, np.where(obeys, 0.0, np.nan))

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
        names = ("driven_ns", "turned_ns", "stood_ns", "silent_ns", "ran_on_ns")
        return dict(zip(names, self._lasted_ns, strict=True))

    @classmethod
    def text(cls, alarm: Alarm, source: Signal, units: AlarmUnits) -> str:
        """See Detector. What it does against which command is the evidence of the first cause."""
        return (alarm.causes[0].evidence if alarm.causes else "") or "does not turn or stop as commanded"


class _Durations:
    """For how long conditions have held, over a block of samples."""

    def __init__(self, valid: Array, period_ns: int) -> None:
        self._valid = valid
        self._period_ns = period_ns

    def of(self, grows: Array, ends: Array, before_ns: Array) -> Array:
        """(..., n, fans) ns: it grows with samples of `grows`, and begins again with those of `ends`; both as many.

        before_ns: (..., fans) after the last block, and after this one when it returns.
        """
        grown: Array = (grows & self._valid).cumsum(axis=-2) * self._period_ns
        ended = ends & self._valid
        at_end = np.maximum.accumulate(np.where(ended, grown, 0), axis=-2)
        has_ended = np.logical_or.accumulate(ended, axis=-2)
        duration = grown - at_end + np.where(has_ended, 0, before_ns[..., np.newaxis, :])
        before_ns[:] = duration[..., -1, :]
        return duration
