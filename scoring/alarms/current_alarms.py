"""The current alarms of a site: the messages about each fan reduced to one.

A fan has one alarm. The newest message carries its state. The cause and who acknowledged it are in earlier messages of
the same occurrence, which tray, fan and onset identify.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from fantwin.schemas.enums import Feedback, Severity, Transition
from fantwin.schemas.messages import Alarm, Diagnosis
from fantwin.schemas.units import NS_PER_S
from fantwin.scoring.alarms.alarm_state import UNTIL_IT_CLEARS_T_NS, is_presented, is_retained, is_silenced

_DESCRIBES_THE_FAN = {
    Transition.NONE,
    Transition.RAISED,
    Transition.SEVERITY,
    Transition.DIAGNOSED,
    Transition.CLEARED,
    Transition.REPUBLISHED,
}
_SAYS_HOW_FAR = {Transition.RAISED, Transition.SEVERITY}
_NAMES_WHO_ACKNOWLEDGED = {Transition.ACKNOWLEDGED, Transition.REPUBLISHED}


@dataclass(frozen=True)
class CurrentAlarm:
    """The alarm of a fan: its newest message, and what earlier messages of the same occurrence add."""

    newest: Alarm
    describing: Alarm | None
    """last message of the occurrence that describes the fan, not an operator's action"""
    causes: tuple[Diagnosis, ...]
    acknowledged_by: str
    raised: Alarm | None = None
    """the last message of the occurrence that says how far the fan is from its twin"""
    commented: Alarm | None = None
    """the last message of the occurrence with a comment of an operator"""

    @property
    def message(self) -> str:
        """The line of the message that describes the fan; empty where there is none."""
        return self.describing.message if self.describing else ""

    @property
    def message_t_ns(self) -> int:
        """Time of the sample that it describes; 0 where it describes none."""
        describing = self.describing
        return describing.t_ns if describing and describing.transition != Transition.REPUBLISHED else 0

    def about(self) -> str:
        """The message without the fan and with its time: commands and speeds in it are those of then."""
        about = self.describing.about if self.describing else ""
        return f"at {clock(self.message_t_ns)}: {about}" if about and self.message_t_ns else about

    def line(self) -> str:
        """The last transition, for a log; a silenced active alarm is marked as such. A refusal says so itself."""
        alarm = self.newest
        word = self.severity() if alarm.active else alarm.transition.name.lower().replace("_", " ")
        is_said = alarm.transition == Transition.REFUSED and not alarm.active
        return "  ".join(([] if is_said else [word]) + [alarm.header.tray, alarm.message])

    def severity(self) -> str:
        """The severity in a log; that of a silenced alarm is marked as such."""
        return f"{self.newest.severity.name}{' (silenced)' if is_silenced(self.newest) else ''}"

    def states(self) -> list[str]:
        """The states the alarm is in, for people."""
        alarm, raised = self.newest, self.newest.severity != Severity.NONE
        states = {
            "active": alarm.active,
            "not confirmed by data": alarm.stale,
            "cleared": raised and not alarm.active,
            "never raised": not raised,
            "unacknowledged": not alarm.acknowledged,
            "acknowledged": raised and alarm.acknowledged,
            f"shelved {until(alarm)}": bool(alarm.shelved_until_t_ns),
            "out of service": alarm.out_of_service,
            marked_by(alarm): alarm.feedback != Feedback.NONE,
        }
        return [state for state, applies in states.items() if applies]

    def as_json(self) -> dict[str, Any]:
        """The alarm for machines (`--json`)."""
        alarm = self.newest
        return {
            "tray": alarm.header.tray,
            "fan": alarm.fan,
            "name": alarm.fan_name,
            "severity": alarm.severity.name.lower(),
            "active": alarm.active,
            "acknowledged": alarm.acknowledged,
            "shelved_until_t_ns": alarm.shelved_until_t_ns,
            "out_of_service": alarm.out_of_service,
            "stale": alarm.stale,
            "retained": is_retained(alarm),
            "presented": is_presented(alarm),
            "onset_t_ns": alarm.onset_t_ns,
            "t_ns": alarm.t_ns,
            "message": self.message,
            "message_t_ns": self.message_t_ns,
            "causes": [
                {"cause": each.cause, "probability": each.probability, "evidence": each.evidence}
                for each in self.causes
            ],
            "acknowledged_by": self.acknowledged_by,
            "feedback": alarm.feedback.name.lower(),
            "feedback_by": alarm.feedback_by,
            "feedback_reason": alarm.feedback_reason,
        }


def needed(messages: Sequence[Alarm]) -> list[Alarm]:
    """The few messages about a fan, in the order sent, from which its current alarm follows.

    The others never matter again, whatever is published next.
    """
    parts = _parts(messages)
    return [alarm for alarm in messages if alarm in parts]


def current_alarm(messages: Sequence[Alarm]) -> CurrentAlarm:
    """The alarm of a fan after these messages, in the order sent."""
    newest, describing, with_causes, acknowledging, raised, commented = _parts(messages)
    return CurrentAlarm(
        newest,
        describing,
        causes=with_causes.causes if with_causes else (),
        acknowledged_by=acknowledging.operator_name if acknowledging and newest.acknowledged else "",
        raised=raised,
        commented=commented,
    )


def _parts(messages: Sequence[Alarm]) -> tuple[Alarm, *tuple[Alarm | None, ...]]:
    """The newest message, and of its occurrence the last that describes the fan, the last with causes, the last that
    says who acknowledged it, the last that says how far the fan is off, and the last with a comment on it."""
    newest = messages[-1]
    occurrence = [alarm for alarm in messages if alarm.onset_t_ns == newest.onset_t_ns]

    def last(applies: Callable[[Alarm], object]) -> Alarm | None:
        return next((alarm for alarm in reversed(occurrence) if applies(alarm)), None)

    return (
        newest,
        last(lambda alarm: alarm.transition in _DESCRIBES_THE_FAN),
        last(lambda alarm: alarm.causes),
        last(lambda alarm: alarm.acknowledged and alarm.transition in _NAMES_WHO_ACKNOWLEDGED),
        last(lambda alarm: alarm.transition in _SAYS_HOW_FAR),
        last(_is_commented),
    )


def _is_commented(alarm: Alarm) -> bool:
    """Whether an operator has commented on this occurrence, not on an earlier one."""
    is_of_earlier = alarm.marked_onset_t_ns not in (0, alarm.onset_t_ns)
    return bool(alarm.comment) and alarm.transition != Transition.REFUSED and not is_of_earlier


def until(alarm: Alarm) -> str:
    """The end of the shelving, for people."""
    if alarm.shelved_until_t_ns == UNTIL_IT_CLEARS_T_NS:
        return "until it clears"
    return f"until {clock(alarm.shelved_until_t_ns)}"


def marked_by(alarm: Alarm) -> str:
    """The feedback on the alarm, for people: what it was, who says so, and why."""
    by = f" by {alarm.feedback_by}" if alarm.feedback_by else ""
    reason = f": {alarm.feedback_reason}" if alarm.feedback_reason else ""
    return f"marked as a {alarm.feedback.words}{by}{reason}"


def clock(t_ns: int) -> str:
    """Local time, with the date unless it is today."""
    at = datetime.fromtimestamp(t_ns / NS_PER_S)
    return at.strftime("%H:%M:%S" if at.date() == datetime.now().date() else "%Y-%m-%d %H:%M:%S")
