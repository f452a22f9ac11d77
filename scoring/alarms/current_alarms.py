"""How the alarms of a site stand: the messages of each fan reduced to one, in words.

A fan has one alarm. Its newest message says how it stands; what it is about, and who acknowledged it, stands in former
messages of the same occurrence, which tray, fan and onset name.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from schemas.messages import Alarm, Diagnosis, Severity, Transition
from scoring.alarms.alarm_flags import is_presented, is_retained, is_silenced
from scoring.alarms.alarm_state import UNTIL_IT_CLEARS_T_NS

_ABOUT_THE_FAN = {
    Transition.NONE,
    Transition.RAISED,
    Transition.SEVERITY,
    Transition.DIAGNOSED,
    Transition.CLEARED,
    Transition.REPUBLISHED,
}
_TELL_WHO = {Transition.ACKNOWLEDGED, Transition.REPUBLISHED}


@dataclass(frozen=True)
class CurrentAlarm:
    """The alarm of a fan: its newest message, and what former ones of this occurrence said."""

    newest: Alarm
    message: str
    causes: tuple[Diagnosis, ...]
    acknowledged_by: str

    def line(self) -> str:
        """What happened last, for a log: nobody is called for what an operator keeps quiet."""
        alarm = self.newest
        word = alarm.severity.name if alarm.active else alarm.transition.name.lower().replace("_", " ")
        silenced = " (silenced)" if alarm.active and is_silenced(alarm) else ""
        return f"{word}{silenced}  {alarm.header.tray}  {alarm.message}"

    def words(self) -> list[str]:
        """The states that it is in."""
        alarm, raised = self.newest, self.newest.severity != Severity.NONE
        states = {
            "active": alarm.active,
            "cleared": raised and not alarm.active,
            "never raised": not raised,
            "unacknowledged": not alarm.acknowledged,
            "acknowledged": raised and alarm.acknowledged,
            "unconfirmed": not alarm.confirmed,
            "latched": alarm.latched,
            f"shelved {until(alarm)}": bool(alarm.shelved_until_t_ns),
            "suppressed": alarm.suppressed,
            "out of service": alarm.out_of_service,
        }
        return [state for state, is_so in states.items() if is_so]

    def as_json(self) -> dict[str, Any]:
        """What a machine is shown."""
        alarm = self.newest
        return {
            "tray": alarm.header.tray,
            "fan": alarm.fan,
            "severity": alarm.severity.name.lower(),
            "active": alarm.active,
            "acknowledged": alarm.acknowledged,
            "confirmed": alarm.confirmed,
            "latched": alarm.latched,
            "shelved_until_t_ns": alarm.shelved_until_t_ns,
            "suppressed": alarm.suppressed,
            "out_of_service": alarm.out_of_service,
            "retained": is_retained(alarm),
            "presented": is_presented(alarm),
            "onset_t_ns": alarm.onset_t_ns,
            "t_ns": alarm.t_ns,
            "message": self.message,
            "causes": [
                {"cause": each.cause, "probability": each.probability, "evidence": each.evidence}
                for each in self.causes
            ],
            "acknowledged_by": self.acknowledged_by,
        }


def current_alarms(messages: Iterable[Alarm]) -> list[CurrentAlarm]:
    """One for each fan that was ever told of, by tray and fan; the messages in the order in which they came."""
    by_fan: dict[tuple[str, int], list[Alarm]] = {}
    for alarm in messages:
        by_fan.setdefault((alarm.header.tray, alarm.fan), []).append(alarm)
    return [_standing(in_sequence(by_fan[fan])) for fan in sorted(by_fan)]


def in_sequence(messages: Iterable[Alarm]) -> list[Alarm]:
    """Messages as they came, but those of each producer by sequence: some may have been asked for again.

    Not by their times: those of a scorer go back when it is fed a recording of long ago.
    """
    came = list(messages)
    of: dict[str, list[Alarm]] = {}
    for alarm in sorted(came, key=lambda alarm: alarm.header.sequence, reverse=True):
        of.setdefault(alarm.header.producer, []).append(alarm)
    return [of[alarm.header.producer].pop() for alarm in came]


def _standing(told: list[Alarm]) -> CurrentAlarm:
    newest = told[-1]
    occurrence = [alarm for alarm in told if alarm.onset_t_ns == newest.onset_t_ns]
    about = [alarm for alarm in occurrence if alarm.transition in _ABOUT_THE_FAN]
    who = [alarm.operator_name for alarm in occurrence if alarm.transition in _TELL_WHO and alarm.acknowledged]
    return CurrentAlarm(
        newest,
        message=about[-1].message if about else "",
        causes=next((alarm.causes for alarm in reversed(occurrence) if alarm.causes), ()),
        acknowledged_by=who[-1] if who and newest.acknowledged else "",
    )


def until(alarm: Alarm) -> str:
    """How long it is shelved."""
    if alarm.shelved_until_t_ns == UNTIL_IT_CLEARS_T_NS:
        return "until it clears"
    return f"until {clock(alarm.shelved_until_t_ns)}"


def clock(t_ns: int) -> str:
    """Local time; the date too, where it is not today's."""
    at = datetime.fromtimestamp(t_ns / 1e9)
    return at.strftime("%H:%M:%S" if at.date() == datetime.now().date() else "%Y-%m-%d %H:%M:%S")
