"""A loose wire: single readings are missing, more of them than of a healthy line.

A CUSUM (Page, Biometrika 41 (1954) 100) of the log likelihood ratio of each reading: missing with the share of a loose
wire, against the share of the healthy line. A reading that is missing right after another one says nothing: an
interruption costs one reading or many, so only its first one counts.

The limit follows from the false alarms wanted. By Wald's inequality for a sequential probability ratio test, from which
Lorden (Annals of Mathematical Statistics 42 (1971) 1897) bounds the run length of the CUSUM, readings between
false alarms are exp(limit) on average, or more. A line with fewer missing readings than its `healthy_share` has by far
fewer false alarms. The sum ends at a cap: good readings take it down again in bounded time.

Readings are those of the grid's samples, so of a line that is faster than the grid the newest one at each sample.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import ClassVar

import numpy as np
from pydantic import Field

from schemas.messages import Alarm, Array
from scoring.detectors.alarm_units import AlarmUnits
from scoring.detectors.cusum import ONE, UNCAPPED, bounded_sums
from scoring.detectors.detector import Detector, DetectorContext, DetectorInput, DetectorSettings, LimitRule, Signal
from scoring.detectors.tacho import LOOSE_S, Tacho

FAULT_SHARE, FAULT_FACTOR, MAX_FAULT_SHARE = 0.15, 3.0, 0.95
"""share of readings that a loose wire costs: the first, or so many times the healthy one; and at most"""
MARGIN, MIN_HEALTHY_SHARE, MAX_HEALTHY_SHARE = 1.5, 0.005, 0.3  # times the largest share of healthy runs
MIN_READINGS = 1000  # of a healthy run, for its share to be known
FALSE_ALARM_EVERY_S = 10 * 86_400.0  # of a fan whose line misses the healthy share
CAP_LIMITS = 2.0
MEMORY_S = 10.0


class MissingReadingsSettings(DetectorSettings):
    """Of MissingReadings."""

    rule: ClassVar[LimitRule] = LimitRule.FIXED
    healthy_share: float = Field(
        default=0.02, gt=0, le=1, description="share of readings that a healthy line may miss, bursts counted once"
    )
    factor: float = Field(default=1.0, gt=0, description="multiplies the limit")

    @classmethod
    def unreached(cls) -> MissingReadingsSettings:
        """See DetectorSettings."""
        return cls(healthy_share=1.0)

    @classmethod
    def fixed(cls, observed: Mapping[str, float]) -> MissingReadingsSettings:
        """More than the largest share of healthy runs."""
        share = MARGIN * observed.get("missing_share", 0.0)
        return cls(healthy_share=min(max(share, MIN_HEALTHY_SHARE), MAX_HEALTHY_SHARE))

    def scaled(self, factor: float) -> MissingReadingsSettings:
        """See DetectorSettings."""
        return self.model_copy(update={"factor": self.factor * factor})


class MissingReadings(Detector):
    """The CUSUM of missing readings, in multiples of its limit."""

    settings = MissingReadingsSettings

    def __init__(self, settings: MissingReadingsSettings, context: DetectorContext) -> None:
        healthy = settings.healthy_share
        fault = min(max(FAULT_SHARE, FAULT_FACTOR * healthy), MAX_FAULT_SHARE)
        self._gain_of_missing = self._gain_of_reading = 0
        if healthy < fault:
            self._gain_of_missing = round(math.log(fault / healthy) * ONE)
            self._gain_of_reading = round(math.log((1.0 - fault) / (1.0 - healthy)) * ONE)
        self._factor, self._is_capped = settings.factor, context.capped
        self._sums = np.zeros(context.fans, np.int64)
        """(fans,) in fixed point"""
        self._was_missing = np.ones(context.fans, np.bool_)
        """(fans,) whether there was no reading before"""
        self._readings, self._interruptions = np.zeros((2, context.fans), np.int64)

    def update(self, block: DetectorInput) -> Array:
        """See Detector. An invalid sample is one at which the line was silent."""
        judged = block.valid & ~block.idle
        missing = block.reading_missing | ~judged
        counted = judged & ~np.vstack((self._was_missing, missing))[:-1]
        self._was_missing = missing[-1].copy()
        self._readings += counted.sum(axis=0)
        self._interruptions += (counted & missing).sum(axis=0)
        gains = np.where(counted, np.where(missing, self._gain_of_missing, self._gain_of_reading), 0)
        limit = self._factor * math.log(max(FALSE_ALARM_EVERY_S / block.period_s, math.e))
        sums = bounded_sums(gains, self._sums, round(CAP_LIMITS * limit * ONE) if self._is_capped else UNCAPPED)
        self._sums = sums[-1].copy()
        return sums / (limit * ONE)

    def reset(self, fans: Array) -> None:
        """See Detector."""
        self._sums[fans] = 0
        self._was_missing[fans] = True

    @property
    def memory_s(self) -> float:
        """A wire that was loose before a longer gap has to show it again."""
        return MEMORY_S

    @property
    def off_delay_s(self) -> float:
        """See Detector. A wire that costs a tenth of the readings is found in less at ten readings a second."""
        return LOOSE_S

    def observed(self) -> dict[str, float]:
        """See Detector."""
        return {"missing_share": float((self._interruptions / np.maximum(self._readings, MIN_READINGS)).max())}

    def columns(self) -> dict[str, Array]:
        """See ColumnState."""
        return {"sums": self._sums, "was_missing": self._was_missing}

    @classmethod
    def text(cls, alarm: Alarm, source: Signal, units: AlarmUnits) -> str:
        """See Detector."""
        return Tacho.text(alarm, source, units)
