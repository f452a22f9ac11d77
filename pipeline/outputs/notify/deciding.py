"""Which alarm a target hears of, when, and what goes into one message.

Pure: what is known of the fan, what the target has heard of it, and the time of the host are given.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from datetime import datetime
from enum import StrEnum
from typing import Self

from pydantic import TypeAdapter

from fantwin.pipeline.outputs.notify.config import TargetConfig
from fantwin.pipeline.site.fleet import Fan
from fantwin.schemas.messages import Alarm
from fantwin.schemas.units import NS_PER_S
from fantwin.scoring.alarms.alarm_state import is_silenced

GATHER_S = 5.0
"""how long a message waits for others that it could be combined with"""
DIGEST_ABOVE = 3
"""messages about more fans than this are combined into one"""
DIGEST_WITHIN_S, LONGEST_S = 30.0, 600.0
"""while more fans keep coming, a combined message waits for up to the first, and each further one twice as long as the
one before, up to the second"""


@dataclass
class Gathered:
    """What goes into the next message. Times are those of the host.

    Attributes:
        in_a_row: how many messages before this one were sent although more fans kept coming.
    """

    opened_ns: int = 0
    newest_ns: int = 0
    in_a_row: int = 0
    fans: dict[Fan, Happened] = field(default_factory=dict)

    def add(self, fan: Fan, happened: Happened, now_ns: int) -> None:
        """Add what has happened to a fan, after what is gathered of it already."""
        if not self.fans:
            self.opened_ns = now_ns
        self.newest_ns = now_ns
        self.fans[fan] = self.fans.get(fan, Happened()).then(happened)

    def to_json(self) -> str:
        """For the outbox."""
        fans = [(*fan, list(each.kinds), each.number) for fan, each in self.fans.items()]
        return json.dumps([self.opened_ns, self.newest_ns, self.in_a_row, fans])

    @classmethod
    def from_json(cls, text: str) -> Self:
        """What `to_json` wrote."""
        opened_ns, newest_ns, in_a_row, fans = json.loads(text)
        happened = {Fan(t, f): Happened(tuple(map(Kind, kinds)), number) for t, f, kinds, number in fans}
        return cls(opened_ns, newest_ns, in_a_row, happened)


def is_due(gathered: Gathered, now_ns: int) -> bool:
    """Whether it becomes a message now. A clock that was set back holds nothing up."""
    if not gathered.fans:
        return False
    waited_ns, silent_ns = abs(now_ns - gathered.opened_ns), abs(now_ns - gathered.newest_ns)
    gather_ns = GATHER_S * NS_PER_S
    if len(gathered.fans) <= DIGEST_ABOVE:
        return waited_ns >= gather_ns
    return silent_ns >= gather_ns or waited_ns >= _longest_ns(gathered)


def next_after(gathered: Gathered, now_ns: int) -> Gathered:
    """What is gathered after a message: nothing. If more fans kept coming, it then waits twice as long for them."""
    is_many = len(gathered.fans) > DIGEST_ABOVE
    keep_coming = is_many and abs(now_ns - gathered.newest_ns) < GATHER_S * NS_PER_S
    return Gathered(in_a_row=gathered.in_a_row + 1 if keep_coming else 0)


def _longest_ns(gathered: Gathered) -> float:
    return min(LONGEST_S, DIGEST_WITHIN_S * 2 ** min(gathered.in_a_row, 10)) * NS_PER_S


def is_quiet(target: TargetConfig, now_ns: int) -> bool:
    """Whether it is a quiet hour of a target, in the time zone of the host."""
    if target.quiet_times is None:
        return False
    now = datetime.fromtimestamp(now_ns / NS_PER_S).time()
    begin, end = target.quiet_times
    return begin <= now < end if begin < end else now >= begin or now < end


def ranges(numbers: Iterable[int]) -> str:
    """Numbers of fans, short: `0-3, 7`."""
    parts: list[list[int]] = []
    for number in sorted(numbers):
        if parts and number == parts[-1][-1] + 1:
            parts[-1] = [parts[-1][0], number]
        else:
            parts.append([number])
    return ", ".join("-".join(map(str, part)) for part in parts)


class Kind(StrEnum):
    """What a target hears of a fan."""

    RAISED = "raised"
    WORSE = "worse"
    CLEARED = "cleared"
    AGAIN = "again"
    ESCALATED = "escalated"
    NOT_CONFIRMED = "not_confirmed"


@dataclass(frozen=True)
class Happened:
    """What happened to a fan since the last message, in order. number: of the last repetition."""

    kinds: tuple[Kind, ...] = ()
    number: int = 0

    def then(self, later: Happened) -> Happened:
        """Join with what happened later."""
        return Happened(self.kinds + later.kinds, later.number or self.number)


class Told(StrEnum):
    """How much of an alarm a target has heard."""

    NOTHING = "nothing"
    BEGUN = "begun"
    ENDED = "ended"


@dataclass(frozen=True)
class Announced:
    """What a target has heard of the last alarm of a fan.

    Attributes:
        severity: the highest that it has heard of.
        last_ns: host time at which it last heard of it, not counting that data do not confirm it. If it has heard
            nothing of the alarm: host time at which the alarm came.
        repeats: how many times it was sent again.
        is_stale_said: it has heard that data do not confirm the alarm.
        was_silenced: an operator has silenced the alarm since.
        owes_end: it has heard an alarm begin that this one has followed without a clear between.
    """

    onset_t_ns: int
    told: Told
    last_ns: int
    severity: int = 0
    repeats: int = 0
    is_stale_said: bool = False
    was_silenced: bool = False
    owes_end: bool = False


ANNOUNCED = TypeAdapter(Announced)
"""its form in the outbox"""


def hears_of(target: TargetConfig, alarm: Alarm) -> bool:
    """Return whether the target hears of such an alarm at all."""
    return alarm.severity >= target.least_severity and _has_tray(target, alarm)


def decide(
    target: TargetConfig, alarm: Alarm, announced: Announced | None, now_ns: int
) -> tuple[Happened | None, Announced | None]:
    """Decide what a target hears of the newest message about a fan. Returns that, and what it has heard afterwards."""
    has_begun = announced is not None and announced.told == Told.BEGUN
    if is_silenced(alarm):
        return None, replace(announced, was_silenced=True) if announced and has_begun else announced
    if not alarm.active:
        if announced is None or not (has_begun or announced.owes_end):
            return None, announced
        return Happened((Kind.CLEARED,)), replace(announced, told=Told.ENDED, last_ns=now_ns, owes_end=False)
    is_other = announced is None or announced.onset_t_ns != alarm.onset_t_ns
    if not _has_tray(target, alarm) or (is_other and has_begun and not hears_of(target, alarm)):
        return None, announced
    if announced is None or is_other:
        owes_end = announced is not None and (has_begun or announced.owes_end)
        announced = Announced(alarm.onset_t_ns, Told.NOTHING, now_ns, owes_end=owes_end)
    if announced.told == Told.ENDED or not hears_of(target, alarm):
        return None, announced
    decided = _begin if announced.told == Told.NOTHING else _continue
    return decided(target, alarm, announced, now_ns)


def _has_tray(target: TargetConfig, alarm: Alarm) -> bool:
    return not target.trays or alarm.header.tray in target.trays


def _begin(target: TargetConfig, alarm: Alarm, announced: Announced, now_ns: int) -> tuple[Happened | None, Announced]:
    after_s = target.escalation_after_s
    if alarm.acknowledged or (after_s is not None and not _has_passed(after_s, announced.last_ns, now_ns)):
        return None, announced
    kind = Kind.RAISED if after_s is None else Kind.ESCALATED
    told = replace(announced, told=Told.BEGUN, last_ns=now_ns, severity=int(alarm.severity), is_stale_said=alarm.stale)
    return Happened((kind,)), told


def _continue(
    target: TargetConfig, alarm: Alarm, announced: Announced, now_ns: int
) -> tuple[Happened | None, Announced]:
    kinds: list[Kind] = []
    now = replace(announced, severity=max(announced.severity, int(alarm.severity)), was_silenced=False)
    if now.severity > announced.severity:
        kinds.append(Kind.WORSE)
    if alarm.stale and not announced.is_stale_said:
        kinds.append(Kind.NOT_CONFIRMED)
        now = replace(now, is_stale_said=True)
    is_due = target.repeat_s > 0 and _has_passed(target.repeat_s, announced.last_ns, now_ns)
    if not alarm.acknowledged and not kinds and (announced.was_silenced or is_due):
        kinds.append(Kind.AGAIN)
        now = replace(now, repeats=announced.repeats + 1)
    # fans raised together are repeated together, also those that data no longer confirm
    if set(kinds) - {Kind.NOT_CONFIRMED}:
        now = replace(now, last_ns=now_ns)
    return Happened(tuple(kinds), now.repeats * (Kind.AGAIN in kinds)) if kinds else None, now


def _has_passed(seconds: float, since_ns: int, now_ns: int) -> bool:
    """A clock that was set back holds nothing up for long: rather too early than hours too late."""
    return abs(now_ns - since_ns) >= seconds * NS_PER_S
