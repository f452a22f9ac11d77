"""The causes that the model of a fan finds probable, as people read them: sizes with intervals, and what would tell.

`cannot_tell` comes first where no cause is as probable as CLEAR. Its probability is that of naming the wrong one; those
of the others add up to one without it.
"""

from __future__ import annotations

import math
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

OF_BALANCE = (Size.DRAG, Size.FRICTION, Size.TORQUE, Size.GAIN)
LEAST_SPEED = 0.05
"""share of the top speed: no fan is taken to turn slower"""
LEAST_DRAG = 0.1
"""share of the torque at the top speed: a smaller drag is not what a fault changes"""


@dataclass(frozen=True)
class SteadyFan:
    """Torque balance of a healthy fan at steady speed: what a change of speed means for drag, friction and gain.

    A fault is known as a share of the top speed. The fan that it slows down settles where the torque of the same
    command is what it needs, so the change of one parameter follows:

        command = friction + viscous w + drag w^2

    The balance is that of the twin's card. Torque is in the unit of the command.
    """

    viscous: float
    drag: float
    friction: float
    top_rad_s: float
    has_own_drive: bool = False
    """true if it controls its speed by itself: its torque is then not known, and a fault is a share of the speed"""
    is_closed_loop: bool = False
    """true if a controller answers its speed by the command: people move the set-point, and not the command"""

    def needed(self, speed_rad_s: float) -> float:
        """Command that holds a speed."""
        return max(self.friction + (self.viscous + self.drag * speed_rad_s) * speed_rad_s, 1e-9)

    def tells(self, size: Size) -> bool:
        """Return whether the balance gives this size."""
        if size == Size.DRAG and self.drag * self.top_rad_s**2 < LEAST_DRAG * self.needed(self.top_rad_s):
            return False
        return not self.has_own_drive

    def size_of(self, size: Size, share: float) -> float:
        """Change that makes the top speed another by a share: relative to drag or gain, or to the torque at the top
        speed."""
        speed = max(1.0 + share, LEAST_SPEED) * self.top_rad_s
        at_top = self.needed(self.top_rad_s)
        taken = at_top - self.needed(speed)
        if size == Size.DRAG:
            return taken / (self.drag * speed**2)
        return -taken / at_top if size == Size.GAIN else taken / at_top


SLOWER, FASTER = 2.0 / 3.0, 4.0 / 3.0
DIGITS = 2

KNOWN_SOON = "more is known in a few seconds"
AT_LIMIT = "its command stays at the limit: its controller can give no more"


@dataclass(frozen=True)
class SeenSinceOnset:
    """Summary of what a fan did since the onset of its alarm."""

    lowest_rad_s: float
    highest_rad_s: float
    lowest_command: float
    highest_command: float


@dataclass(frozen=True)
class Advice:
    """Writes what would tell the cause of an alarm, if what was seen since its onset does not.

    Causes differ in how they change with the speed (docs/explanation/diagnosis.md), so what is missing is motion: a
    change of the speed by a third, beyond the speeds that were seen. The command for it follows from the healthy torque
    balance. It is in the unit of the command; the advice is empty where the twin does not name it.
    """

    command_unit: str = ""
    lowest_command: float = 0.0
    """the lowest one that turns a healthy fan: none below it is advised"""
    highest_command: float = math.inf
    """the highest one that the twin knows: none above it is advised"""

    def added_to(self, unclear: str, seen: SeenSinceOnset, fan: SteadyFan) -> str:
        """Why the cause is unclear, with what would tell."""
        if fan.is_closed_loop:
            return f"{unclear}: change its set-point by a third for ten seconds, and back"
        command = self._other_command(seen, fan)
        if not math.isfinite(command):
            return unclear
        return f"{unclear}: move the command to {self._of(command)} for ten seconds, and back"

    def _other_command(self, seen: SeenSinceOnset, fan: SteadyFan) -> float:
        """Find a command that gives a lower speed or, where that turns no fan, a higher one; NaN where there is
        neither."""
        low, high = seen.lowest_rad_s, seen.highest_rad_s
        if not 0.0 < low <= high < math.inf:
            return math.nan
        slower = seen.lowest_command * fan.needed(SLOWER * low) / fan.needed(low)
        if slower >= self.lowest_command:
            return slower
        faster = seen.highest_command * fan.needed(FASTER * high) / fan.needed(high)
        faster = min(faster, self.highest_command)
        return faster if faster > seen.highest_command else math.nan

    def _of(self, command: float) -> str:
        size = abs(command)
        digits = max(DIGITS - 1 - math.floor(math.log10(size)), 0) if size > 0.0 else 0
        return f"{command:.{digits}f}{f' {self.command_unit}' if self.command_unit else ''}"


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
        if fan.is_closed_loop and seen.lowest_command == seen.highest_command >= self._advice.highest_command:
            listed = (replace(listed[0], evidence=f"{listed[0].evidence}; {AT_LIMIT}"), *listed[1:])
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
