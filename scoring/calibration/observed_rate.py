"""Observed rate of false alarms, beside the declared one.

Operators say which alarms were false. An alarm that is not marked may be either, so it is counted apart.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from fantwin.schemas.twin_card import CardError, TwinCard
from fantwin.scoring.calibration.alarm_rate import HOURS_PER_DAY, daily_interval
from fantwin.scoring.calibration.calibration import Calibration


@dataclass(frozen=True)
class ObservedRate:
    """The alarms that were raised while fans were judged, and for how long they were.

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
    def text(self) -> str:
        """The result in one line, without its time."""
        count = f"{self.false_alarms} false alarm{'s' * (self.false_alarms != 1)}"
        declared = "no rate is declared" if self.declared_per_day is None else f"declared {self.declared_per_day:.3g}"
        if not self.fan_hours:
            return f"{count}, and how long fans were judged is not known; {declared}"
        found = f"{count} in {_number(self.fan_hours)} judged fan-hours: {self._rate(self.false_alarms)}"
        if self.unmarked:
            are, them = ("is", "it") if self.unmarked == 1 else ("are", "them")
            possible = self._rate(self.false_alarms + self.unmarked)
            found += f"; {self.unmarked} more {are} not marked, with {them} {possible}"
        return f"{found}; {declared}"

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
