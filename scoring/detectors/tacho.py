"""The tacho itself: readings that repeat, and readings that are missing.

A stuck tacho repeats its last value. A healthy one may do so for a while; calibration measures for how long. A tacho
that counts or holds its readings repeats them for as long as the fan runs evenly. Of such a tacho only samples count at
which a healthy fan would read something else, because its speed has changed by more than the tacho resolves, and is now
away from the reading by half of that or more. Missing readings are limited by their share. While the command stops the
fan, and while it starts, neither is judged.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import numpy as np
from pydantic import Field

from schemas.messages import Alarm, Array
from schemas.units import NS_PER_S
from scoring.detectors.alarm_units import AlarmUnits
from scoring.detectors.detector import (
    UNREACHED,
    Detector,
    DetectorContext,
    DetectorInput,
    DetectorSettings,
    LimitRule,
    Signal,
)
from scoring.detectors.low_pass import LowPass

MISSING_TIME_CONSTANT_S = 2.0
LOOSE_S = 30.0  # a loose contact comes and goes: after so long without a failure it is taken to be good again
MOVED_STEPS, MOVED_SHARE = 3.0, 0.1  # of the resolution, and of the speed: less may be noise, or an error of the twin
AWAY = 0.5  # of that: a reading that is nearer to what a healthy fan would read says that the tacho works
STUCK_MARGIN, MIN_STUCK_S = 3.0, 2.0  # times the longest repetition of healthy runs
MISSING_MARGIN, MIN_MISSING_SHARE, MAX_MISSING_SHARE = 3.0, 0.25, 0.9  # times the largest share of healthy runs


def moved(
    expected_rad_s: Array, first_rad_s: Array | float, resolution_rad_s: Array | float, share: float = 1.0
) -> Array:
    """Where a healthy fan would read something else than at first, by more than its tacho resolves, or than a share of
    that; all rad/s.
    """
    least = share * np.maximum(MOVED_STEPS * resolution_rad_s, MOVED_SHARE * np.abs(first_rad_s))
    return np.asarray(np.abs(expected_rad_s - first_rad_s) > least)


class TachoSettings(DetectorSettings):
    """Of Sensor."""

    rule: ClassVar[LimitRule] = LimitRule.FIXED
    stuck_s: float = Field(default=5.0, gt=0, description="how long a reading may repeat")
    missing_share: float = Field(default=0.25, gt=0, le=1, description="share of readings that may be missing")

    @classmethod
    def unreached(cls) -> TachoSettings:
        """See DetectorSettings."""
        return cls(stuck_s=UNREACHED, missing_share=1.0)

    @classmethod
    def fixed(cls, observed: Mapping[str, float]) -> TachoSettings:
        """Limits by the longest repetition and the largest missing share of healthy runs."""
        share = max(MIN_MISSING_SHARE, MISSING_MARGIN * observed.get("missing_share", 0.0))
        return cls(
            stuck_s=max(MIN_STUCK_S, STUCK_MARGIN * observed.get("stuck_s", 0.0)),
            missing_share=min(MAX_MISSING_SHARE, share),
        )

    def scaled(self, factor: float) -> TachoSettings:
        """The limit of repetition scales; a share of missing readings cannot go far beyond its limit."""
        return self.model_copy(update={"stuck_s": self.stuck_s * factor})


class Tacho(Detector):
    """How long each reading has repeated, or the share of missing ones, whichever is closer to its limit."""

    settings = TachoSettings

    def __init__(self, settings: TachoSettings, context: DetectorContext) -> None:
        self._settings = settings
        self._last = np.full(context.fans, np.nan)
        """(fans,) the last reading, rad/s"""
        self._repeated_ns = np.zeros(context.fans, np.int64)
        """(fans,) for how long it has repeated"""
        self._healthy_rad_s = np.full(context.fans, np.nan)
        """(fans,) what a healthy fan would have read when the reading began to repeat"""
        self._holds = np.array([tacho.kind != "instantaneous" for tacho in context.tachos])
        self._resolution_rad_s = np.array([tacho.resolution_rad_s for tacho in context.tachos])
        self._missing = LowPass(context.fans, MISSING_TIME_CONSTANT_S)
        self._longest_s = self._largest_share = 0.0

    def update(self, block: DetectorInput) -> Array:
        """See Detector. An invalid sample is one at which the line was silent."""
        judged = block.valid & ~block.idle
        speed_rad_s = np.where(judged & np.isfinite(block.speed_rad_s), block.speed_rad_s, np.nan)
        stuck_s = self._stuck_s(speed_rad_s, block.predicted_rad_s, block.period_ns)
        share = self._missing.update(block.missing.astype(np.float64), judged, block.period_s)
        self._longest_s = max(self._longest_s, float(stuck_s.max()))
        self._largest_share = max(self._largest_share, float(share.max()))
        return np.maximum(stuck_s / self._settings.stuck_s, share / self._settings.missing_share)

    def _stuck_s(self, speed_rad_s: Array, predicted_rad_s: Array, period_ns: int) -> Array:
        """(n, fans) for how long each reading has repeated, s, against the prediction where the tacho holds readings.

        A fan at rest reads zero and is not stuck.
        """
        before = np.vstack((self._last, speed_rad_s))[:-1]
        same = (speed_rad_s == before) & (speed_rad_s != 0.0)
        rows = np.arange(1, len(speed_rad_s) + 1)[:, np.newaxis]
        changed = np.maximum.accumulate(np.where(same, 0, rows), axis=0)
        counted: Array = same
        if self._holds.any():
            first = np.take_along_axis(predicted_rad_s, np.maximum(changed - 1, 0), axis=0)
            first = np.where(changed == 0, self._healthy_rad_s, first)
            elsewhere = moved(predicted_rad_s, first, self._resolution_rad_s)
            elsewhere &= moved(predicted_rad_s, speed_rad_s, self._resolution_rad_s, AWAY)
            counted = same & (~self._holds | elsewhere)
            self._healthy_rad_s = first[-1].copy()
        total = np.cumsum(counted, axis=0) * period_ns
        at_change = np.maximum.accumulate(np.where(same, 0, total), axis=0)
        repeated_ns = total - at_change + np.where(changed == 0, self._repeated_ns, 0)
        self._last, self._repeated_ns = speed_rad_s[-1].copy(), repeated_ns[-1].copy()
        return repeated_ns / NS_PER_S

    def reset(self, fans: Array) -> None:
        """See Detector."""
        self._repeated_ns[fans] = 0
        self._missing.reset(fans)

    @property
    def memory_s(self) -> float:
        """Of the share of missing readings. A repetition ends at the first sample without a reading."""
        return self._missing.memory_s

    @property
    def off_delay_s(self) -> float:
        """See Detector."""
        return LOOSE_S

    def observed(self) -> dict[str, float]:
        """See Detector."""
        return {"stuck_s": self._longest_s, "missing_share": self._largest_share}

    def columns(self) -> dict[str, Array]:
        """See ColumnState."""
        held = {"healthy_rad_s": self._healthy_rad_s} if self._holds.any() else {}
        return {"last": self._last, "repeated_ns": self._repeated_ns, **held, "missing": self._missing.value}

    @classmethod
    def text(cls, alarm: Alarm, source: Signal, units: AlarmUnits) -> str:
        """See Detector."""
        return "the tacho repeats one reading, or gives none"
