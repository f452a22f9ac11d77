"""Calibration of a twin's alarms by healthy recordings: the entry `calibration` of its card, and the check of a limit.

The limit follows from the declared rate alone (scoring.model.onsets), and healthy recordings check it. If they have
more false alarms than chance explains, the log of the limit is raised until they have no more than declared. Peaks far
beyond chance do not raise it: they are faults.

A rate can be shown only by enough running: at the declared rate, SHOWN_BY false alarms must be expected. If none
occurs, the true rate is no higher than declared, with 95 % confidence (the rule of three). With less it is a target.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, field_serializer

from fantwin.schemas.messages import Array
from fantwin.scoring.calibration.alarm_rate import HOURS_PER_DAY, daily_interval
from fantwin.scoring.model.priors import Priors

SHOWN_BY = 3.0
EXCEEDED_UNTIL = 0.5
"""score below which an excursion above the limit has ended"""
BEYOND = 1.0 + 1e-9
"""ratio of a raised limit to the peak that must stay below it"""


class Calibration(BaseModel):
    """Entry `calibration` of a card.

    false_alarms_per_day: declared, of each fan. limit_factor: on the log of the limit that follows from it. fan_hours:
    of healthy running that was compared with the twin, in `runs` runs. found: false alarms in it by this calibration.
    interval_95: of the rate of false alarms per fan and day that they show. data: the recordings: name and SHA-256,
    from_s, to_s of a part, tray of several.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    false_alarms_per_day: float = Field(gt=0)
    priors: Priors = Priors()
    limit_factor: float = Field(default=1.0, ge=1.0)
    fan_hours: float = Field(gt=0)
    runs: int = Field(ge=1)
    found: int = Field(ge=0)
    interval_95: tuple[float, float]
    data: tuple[dict[str, Any], ...] = ()
    created: str = ""

    @field_serializer("priors")
    def _changed_priors(self, priors: Priors) -> dict[str, float]:
        """Priors that differ from a population's."""
        return changed_priors(priors)

    @property
    def is_target(self) -> bool:
        """Return whether the recordings do not show the rate: they are too few, or have more false alarms."""
        return not supports(self.fan_hours, self.false_alarms_per_day) or self.is_exceeded

    @property
    def is_exceeded(self) -> bool:
        """Return whether the recordings have more false alarms than chance explains by the rate."""
        return is_exceeded(self.found, self.fan_hours, self.false_alarms_per_day)


def changed_priors(priors: Priors) -> dict[str, float]:
    """Priors that differ from a population's."""
    of_population = asdict(Priors())
    return {name: value for name, value in asdict(priors).items() if value != of_population[name]}


def expected_alarms(fan_hours: float, per_day: float) -> float:
    """Number of false alarms by a rate per fan and day."""
    return per_day * fan_hours / HOURS_PER_DAY


def needed_fan_hours(per_day: float) -> float:
    """Healthy running that can show a rate."""
    return SHOWN_BY * HOURS_PER_DAY / per_day


def supports(fan_hours: float, per_day: float) -> bool:
    """Return whether `fan_hours` of healthy running can show a rate."""
    return expected_alarms(fan_hours, per_day) >= SHOWN_BY


def least_per_day(fan_hours: float) -> float:
    """Lowest rate, of two digits, that `fan_hours` of healthy running can show."""
    rate = needed_fan_hours(fan_hours)  # hours and rate are interchangeable
    digits = 1 - math.floor(math.log10(rate))
    while not supports(fan_hours, rounded := float(f"{math.ceil(rate * 10.0**digits) / 10.0**digits:.2g}")):
        rate *= BEYOND
    return rounded


def is_exceeded(found: int, fan_hours: float, per_day: float) -> bool:
    """Return whether there were more false alarms than chance explains by a rate: its whole 95 % interval is above."""
    return daily_interval(found, fan_hours)[0] > per_day


class Excursions:
    """Peaks of the score of each fan, one for each time that it exceeds its limit, 1."""

    def __init__(self, fans: int) -> None:
        """Begin without one."""
        self._peak = np.zeros(fans)
        self._ended: list[float] = []

    def take(self, score: Array) -> None:
        """Process the score at the end of a bin, (fans,)."""
        is_one = (self._peak > 0.0) | (score > 1.0)
        if is_one.any():
            self._peak = np.where(is_one, np.maximum(self._peak, score), 0.0)
            ends = is_one & (score < EXCEEDED_UNTIL)
            self._ended += self._peak[ends].tolist()
            self._peak[ends] = 0.0

    @property
    def peaks(self) -> list[float]:
        """Peaks so far."""
        return [*self._ended, *self._peak[self._peak > 0.0].tolist()]


def raised_limit(peaks: Sequence[float], allowed: int) -> float:
    """Find the least factor of the limit, at least 1, that no more than `allowed` of the peaks exceed."""
    falling = sorted(peaks, reverse=True)
    return max(1.0, falling[allowed] * BEYOND) if allowed < len(falling) else 1.0
