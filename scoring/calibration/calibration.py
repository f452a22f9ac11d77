"""Calibration of a twin's alarms by healthy recordings: the entry `calibration` of its card, and the check of a limit.

The limit follows from the declared rate alone (scoring.model.onsets), and healthy recordings check it. If they have
more false alarms than chance explains, the log of the limit is raised until they have no more than declared. Peaks far
beyond chance do not raise it: they are faults.

A rate can be shown only by enough running: at the declared rate, SHOWN_BY false alarms must be expected. If none
occurs, the true rate is no higher than declared, with 95 % confidence (the rule of three). With less it is a target.

In service, the observed rate of false alarms stands beside the declared one (`ObservedRate`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, field_serializer

from fantwin.schemas.messages import Array
from fantwin.schemas.twin_card import CardError, TwinCard
from fantwin.scoring.model.population import Priors

COVERAGE = 0.95
HOURS_PER_DAY = 24.0


def daily_interval(count: float, fan_hours: float) -> tuple[float, float]:
    """Compute the 95 % interval of the rate per fan and day from the count in `fan_hours`.

    The interval is that of Garwood, Biometrika 28 (1936) 437.
    """
    from scipy.special import gammaincinv  # noqa: PLC0415  scipy takes long to import, and stages do without

    outside = (1.0 - COVERAGE) / 2
    low = gammaincinv(count, outside) if count > 0 else 0.0
    high = gammaincinv(count + 1, 1.0 - outside)
    return float(low) / fan_hours * HOURS_PER_DAY, float(high) / fan_hours * HOURS_PER_DAY


ENOUGH_EXPECTED, ENOUGH_RATIO = 3.0, 10.0
"""see `says_something`: expected false alarms, and ratio of the upper bound to the declared rate"""


@dataclass(frozen=True)
class ObservedRate:
    """The alarms that were raised while fans were judged, and for how long they were.

    Operators say which alarms were false. An alarm that is not marked may be either, so it is counted apart.

    Attributes:
        since_t_ns: the first judged sample; 0: there was none.
        fan_hours: judged time, summed over fans.
        false_alarms, true_alarms, unmarked: alarms raised in that time, by what operators said of them.
        declared_per_day: false alarms per fan and day; None: none are declared.
    """

    since_t_ns: int
    fan_hours: float
    false_alarms: int
    true_alarms: int
    unmarked: int
    declared_per_day: float | None

    def per_day(self, alarms: int) -> float:
        """Convert a number of alarms to a rate per fan and day."""
        return alarms / self.fan_hours * HOURS_PER_DAY

    def interval_95(self, alarms: int) -> tuple[float, float]:
        """The exact 95 % interval of the rate of independent alarms (Garwood), per fan and day."""
        return daily_interval(alarms, self.fan_hours)

    @property
    def says_something(self) -> bool:
        """Whether fans were judged for long enough to compare the rate with the declared one.

        So many false alarms were to be expected, or the interval ends within ten times the declared rate. Where none is
        declared, a day of one fan is enough.
        """
        if self.declared_per_day is None or not self.fan_hours:
            return self.fan_hours >= HOURS_PER_DAY
        expected = self.declared_per_day * self.fan_hours / HOURS_PER_DAY
        _, upper = self.interval_95(self.false_alarms)
        return expected >= ENOUGH_EXPECTED or upper < ENOUGH_RATIO * self.declared_per_day

    @property
    def text(self) -> str:
        """The result in one line, without its time."""
        count = f"{self.false_alarms} false alarm{'s' * (self.false_alarms != 1)}"
        declared = "no rate is declared" if self.declared_per_day is None else f"declared {self.declared_per_day:.3g}"
        if not self.fan_hours:
            return f"{count}, and how long fans were judged is not known; {declared}"
        found = f"{count} in {_number(self.fan_hours)} judged fan-hours"
        are, them = ("is", "it") if self.unmarked == 1 else ("are", "them")
        unmarked = f"; {self.unmarked} more {are} not marked" if self.unmarked else ""
        if not self.says_something:
            return f"{found}, too few to tell a rate{unmarked}; {declared}"
        if self.unmarked:
            unmarked += f", with {them} {self._rate(self.false_alarms + self.unmarked)}"
        return f"{found}: {self._rate(self.false_alarms)}{unmarked}; {declared}"

    def as_json(self) -> dict[str, Any]:
        """Convert for machines; rates are null where no fan was judged."""
        known = bool(self.fan_hours)
        possible = self.false_alarms + self.unmarked
        return {
            "since_t_ns": self.since_t_ns,
            "fan_hours": self.fan_hours,
            "false_alarms": self.false_alarms,
            "true_alarms": self.true_alarms,
            "unmarked": self.unmarked,
            "false_alarms_per_day": self.per_day(self.false_alarms) if known else None,
            "interval_95": self.interval_95(self.false_alarms) if known else None,
            "with_unmarked_per_day": self.per_day(possible) if known else None,
            "with_unmarked_interval_95": self.interval_95(possible) if known else None,
            "declared_per_day": self.declared_per_day,
            "enough": self.says_something,
            "text": self.text,
        }

    def _rate(self, alarms: int) -> str:
        low, high = self.interval_95(alarms)
        return f"{_number(self.per_day(alarms))} per fan and day (95 %: {_number(low)} to {_number(high)})"


def _number(value: float) -> str:
    """Format for people: two digits are enough, and large numbers have no exponent."""
    return f"{value:,.0f}" if value >= 10.0 else f"{value:.2g}"


def declared_per_day(card_json: str) -> float | None:
    """The rate that a twin's card declares, false alarms per fan and day; None: it declares none, or cannot be read."""
    try:
        calibration = TwinCard.from_json(card_json).calibration
        return Calibration.model_validate(calibration).false_alarms_per_day if calibration else None
    except (CardError, ValueError):
        return None


def together(rates: Sequence[ObservedRate]) -> ObservedRate:
    """The rate of several trays: per fan and day of all their fans. Declared is the mean over the judged time; None if
    one of them declares none."""
    fan_hours = sum(each.fan_hours for each in rates)
    weighed = [(each.declared_per_day, each.fan_hours) for each in rates if each.fan_hours or not fan_hours]
    known = [(rate, hours) for rate, hours in weighed if rate is not None]
    declared = None
    if known and len(known) == len(weighed):
        total = sum(hours for _, hours in known)
        declared = sum(rate * hours for rate, hours in known) / total if total else known[0][0]
    return ObservedRate(
        since_t_ns=min((each.since_t_ns for each in rates if each.since_t_ns), default=0),
        fan_hours=fan_hours,
        false_alarms=sum(each.false_alarms for each in rates),
        true_alarms=sum(each.true_alarms for each in rates),
        unmarked=sum(each.unmarked for each in rates),
        declared_per_day=declared,
    )


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
