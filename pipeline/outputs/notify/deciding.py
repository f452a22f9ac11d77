"""Which alarm a target hears of, and when: raised, worse, cleared, again, escalated, not confirmed by data.

Pure: what is known of the fan, what the target has heard of it, and the time of the host are given.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, replace
from enum import StrEnum
from typing import Self

from fantwin.pipeline.outputs.notify.config import TargetConfig
from fantwin.pipeline.outputs.notify.fan_alarm import FanAlarm
from fantwin.schemas.units import NS_PER_S


class Kind(StrEnum):
    """What a target hears of a fan."""

    RAISED = "raised"
    WORSE = "worse"
    CLEARED = "cleared"
    AGAIN = "again"
    ESCALATED = "escalated"
    NOT_CONFIRMED = "not_confirmed"


@dataclass(frozen=True)
class Event:
    """Tray, fan, onset, kind and number identify it: a target hears of it once.

    number: of a repetition, from 1; of the severity that it is worse by; else 0.
    """

    tray: str
    fan: int
    onset_t_ns: int
    kind: Kind
    number: int = 0


@dataclass(frozen=True)
class Announced:
    """What a target has heard of the last alarm of a fan.

    Attributes:
        is_open: it has not heard that the alarm is over.
        last_ns: when it last heard of it, by the clock of the host; not that data do not confirm it.
        repeats: how many times it was sent again.
        is_stale_said: it has heard that data do not confirm the alarm.
        was_silenced: an operator has silenced the alarm since.
    """

    onset_t_ns: int
    severity: int
    is_open: bool
    last_ns: int
    repeats: int = 0
    is_stale_said: bool = False
    was_silenced: bool = False

    def to_json(self) -> str:
        """For the outbox."""
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, text: str) -> Self:
        """What `to_json` wrote."""
        return cls(**json.loads(text))


def hears_of(target: TargetConfig, alarm: FanAlarm) -> bool:
    """Whether it hears of such an alarm at all."""
    return alarm.severity >= target.least_severity and (not target.trays or alarm.tray in target.trays)


def decide(
    target: TargetConfig, alarm: FanAlarm, announced: Announced | None, now_ns: int
) -> tuple[list[Event], Announced | None]:
    """What a target hears of a fan now, and what it has heard then."""
    has_open = announced is not None and announced.is_open
    if alarm.silenced:
        return [], replace(announced, was_silenced=True) if announced and has_open else announced
    if not alarm.active:
        return _end(alarm, announced, now_ns) if announced and has_open else ([], announced)
    if hears_of(target, alarm):
        if announced is None or announced.onset_t_ns != alarm.onset_t_ns:
            return _begin(target, alarm, announced, now_ns)
        if has_open:
            return _continue(target, alarm, announced, now_ns)
    return [], announced


def _begin(
    target: TargetConfig, alarm: FanAlarm, announced: Announced | None, now_ns: int
) -> tuple[list[Event], Announced | None]:
    if alarm.acknowledged:  # somebody knows
        return [], announced
    kind = Kind.RAISED
    if target.escalation_after_s is not None:
        if not _has_passed(target.escalation_after_s, alarm.first_heard_ns, now_ns):
            return [], announced
        kind = Kind.ESCALATED
    event = Event(alarm.tray, alarm.fan, alarm.onset_t_ns, kind)
    return [event], Announced(alarm.onset_t_ns, alarm.severity, True, now_ns, is_stale_said=alarm.stale)


def _end(alarm: FanAlarm, announced: Announced, now_ns: int) -> tuple[list[Event], Announced]:
    cleared = Event(alarm.tray, alarm.fan, announced.onset_t_ns, Kind.CLEARED)
    return [cleared], replace(announced, is_open=False, last_ns=now_ns)


def _continue(
    target: TargetConfig, alarm: FanAlarm, announced: Announced, now_ns: int
) -> tuple[list[Event], Announced]:
    events: list[Event] = []

    def add(kind: Kind, number: int = 0) -> None:
        events.append(Event(alarm.tray, alarm.fan, alarm.onset_t_ns, kind, number))

    now = replace(announced, severity=alarm.severity, was_silenced=False)
    if alarm.severity > announced.severity:
        add(Kind.WORSE, alarm.severity)
    if alarm.stale and not announced.is_stale_said:
        add(Kind.NOT_CONFIRMED)
        now = replace(now, is_stale_said=True)
    is_due = target.repeat_s > 0 and _has_passed(target.repeat_s, announced.last_ns, now_ns)
    if not alarm.acknowledged and not events and (announced.was_silenced or is_due):
        now = replace(now, repeats=announced.repeats + 1)
        add(Kind.AGAIN, now.repeats)
    # of fans that were raised together, those that data do not confirm stay together with the others
    is_reminded = any(event.kind != Kind.NOT_CONFIRMED for event in events)
    return events, replace(now, last_ns=now_ns) if is_reminded else now


def _has_passed(seconds: float, since_ns: int, now_ns: int) -> bool:
    """A clock that was set back holds nothing up for long: rather too early than hours too late."""
    return abs(now_ns - since_ns) >= seconds * NS_PER_S
