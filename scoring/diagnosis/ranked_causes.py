"""The causes that the model of a fan finds probable, as people read them: sizes with intervals, and what would tell.

`cannot_tell` comes first where no cause is as probable as CLEAR. Its probability is that of naming the wrong one; those
of the others add up to one without it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from fantwin.schemas.messages import Diagnosis
from fantwin.scoring.diagnosis.causes import (
    CANNOT_TELL,
    CAUSES,
    GAIN_DOWN,
    MIN_PROBABILITY,
    ROWS,
    Size,
    is_of_standstill,
    short_name,
)
from fantwin.scoring.diagnosis.steady_fan import OF_BALANCE, SteadyFan
from fantwin.scoring.diagnosis.what_would_tell import Advice, SeenSinceOnset

CLEAR = 0.6
"""least probability of a cause that is named first: below it, the first cause is wrong too often"""
DRIVER_SHARE = 0.5
"""share of the prior of less drive: the other half is a weak supply"""
NEWS = 0.1
"""change of a probability that is worth a message"""
SIGMAS = 1.96
"""half of a 95 % interval"""
UNITS = {Size.FRICTION: "share", Size.TORQUE: "share", Size.MISSING: "share", Size.SPREAD: "times"}
"""unit of the change: share of the torque at the top speed or of the readings, multiples of a healthy fan's; else
relative to the healthy value"""
STEADY_SHARE = 0.05
"""a speed that varies by less than this share tells drag, friction and gain little apart"""
NARROW = 2.0
"""width in per cent below which an interval has a decimal"""


@dataclass(frozen=True)
class PossibleCause:
    """Cause of an alarm, with its share of the posterior.

    change: share of the top speed that the fault takes (negative) or gives by now; of a tacho, share of the reading, or
    of the readings that are missing; of an unsteady speed, its standard deviation as a multiple of a healthy fan's.
    std: its standard deviation; NaN or 0: not known.
    """

    cause: str
    probability: float
    change: float
    std: float


class CauseWords:
    """Writes the causes of the alarms of one tray."""

    def __init__(self, advice: Advice, has_supply: bool) -> None:
        """has_supply: whether the twin allows for a measured supply voltage; less drive is then the driver's."""
        self._advice, self._has_supply = advice, has_supply

    def of(self, causes: Sequence[PossibleCause], seen: SeenSinceOnset, fan: SteadyFan) -> tuple[Diagnosis, ...]:
        """The causes that are listed, the most probable first; empty where there are none."""
        ranked = self._ranked(causes)
        if not ranked:
            return ()
        least = min(MIN_PROBABILITY, ranked[0].probability)
        listed = tuple(self._words(each, fan) for each in ranked if each.probability >= least)
        if ranked[0].probability >= CLEAR:
            return listed
        evidence = self._advice.added_to(_why_unclear(ranked, seen), seen, fan)
        unclear = Diagnosis(cause=CANNOT_TELL, probability=1.0 - ranked[0].probability, evidence=evidence)
        return (unclear, *listed)

    def _ranked(self, causes: Sequence[PossibleCause]) -> list[PossibleCause]:
        """Rank causes, most probable first. A measured supply leaves less drive the share of its prior that is the
        driver's."""
        weights = [
            each.probability * (DRIVER_SHARE if self._has_supply and each.cause == GAIN_DOWN else 1.0)
            for each in causes
        ]
        total = sum(weights) or 1.0
        weighed = [replace(each, probability=one / total) for each, one in zip(causes, weights, strict=True)]
        return sorted(weighed, key=lambda each: -each.probability)

    def _words(self, one: PossibleCause, fan: SteadyFan) -> Diagnosis:
        size = next((row.size for row in ROWS if row.cause == one.cause), Size.SPEED)
        shares = (one.change - SIGMAS * one.std, one.change, one.change + SIGMAS * one.std)
        if size in OF_BALANCE and fan.tells(size):
            shares = tuple(fan.size_of(size, share) for share in shares)
        elif size in OF_BALANCE:
            size = Size.SPEED
        elif size == Size.MISSING:
            shares = tuple(min(max(share, 0.0), 1.0) for share in shares)
        words = _size_in_words(size, shares[1], min(shares), max(shares))
        if self._has_supply and one.cause == GAIN_DOWN:
            words = f"{words}, beyond the supply voltage, which is measured"
        return Diagnosis(
            cause=one.cause,
            probability=one.probability,
            parameter=size.value,
            change=shares[1],
            unit=UNITS.get(size, "relative"),
            evidence=words,
        )


def says_more(causes: Sequence[Diagnosis], than: Sequence[Diagnosis]) -> bool:
    """Return whether causes are worth a message after others: in another order, or with other probabilities.

    A fan that turns again has recovered: causes found after that describe the end of the fault.
    """
    stood, stands = (bool(each) and is_of_standstill(each[0]) for each in (than, causes))
    if stood and not stands:
        return False
    if [each.cause for each in causes] != [each.cause for each in than]:
        return True
    return any(abs(new.probability - old.probability) >= NEWS for new, old in zip(causes, than, strict=True))


def _why_unclear(ranked: Sequence[PossibleCause], seen: SeenSinceOnset) -> str:
    if not seen.highest_rad_s - seen.lowest_rad_s >= STEADY_SHARE * seen.highest_rad_s:
        return f"{CAUSES[CANNOT_TELL]}: the speed has changed too little since the alarm began"
    one, other = (short_name(each.cause) for each in ranked[:2])
    return f"{CAUSES[CANNOT_TELL]}: {one} and {other} explain it alike"


def _size_in_words(size: Size, change: float, low: float, high: float) -> str:
    """A size and its 95 % interval."""
    if size == Size.STUCK:
        return "its reading stays the same although the speed should change"
    if size == Size.SPREAD:
        interval = f" (95 %: {low:.1f} to {high:.1f})" if high > low else ""
        return f"its speed varies {change:.1f} times as much as that of a healthy fan{interval}"
    low, change, high = 100.0 * low, 100.0 * change, 100.0 * high
    digits = 1 if high - low < NARROW else 0
    interval = f" (95 %: {low:.{digits}f} to {high:.{digits}f})" if high > low else ""
    if size == Size.MISSING:
        return f"{change:.{digits}f} % of the readings are missing{interval}"
    of_torque = " of the torque at full speed" if size in (Size.FRICTION, Size.TORQUE) else ""
    return f"{size} {change:+.{digits}f} %{of_torque}{interval}"
