"""The alarm of a fan as messages need it, kept across restarts."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, replace
from typing import Self

from fantwin.schemas.enums import Severity, Transition
from fantwin.schemas.messages import Alarm
from fantwin.scoring.alarms.alarm_flags import is_presented, is_silenced

FanName = tuple[str, int]
"""tray and fan"""
MOST_EARLIER = 8
_WITH_DEVIATION = (Transition.RAISED, Transition.SEVERITY)
_NAMES_WHO_ACKNOWLEDGED = (Transition.ACKNOWLEDGED, Transition.REPUBLISHED)


@dataclass(frozen=True)
class NamedCause:
    """A cause of scoring.diagnosis.shown_causes, its probability, and the evidence in words."""

    cause: str
    probability: float
    evidence: str


@dataclass(frozen=True)
class FanAlarm:
    """After the newest message about a fan, which `producer` and `sequence` name."""

    tray: str
    fan: int
    producer: str
    sequence: int
    onset_t_ns: int
    first_heard_ns: int
    """when this occurrence was first presented here, by the clock of the host; 0: not yet"""
    active: bool
    severity: int
    acknowledged: bool
    acknowledged_by: str
    presented: bool
    silenced: bool
    stale: bool
    deviation: str
    """how far the fan is from its twin, as the last message of this occurrence that said so has it; may be empty"""
    causes: tuple[NamedCause, ...]
    deviation_t_ns: int = 0
    """when that was, by the clock of the device; 0: unknown"""
    earlier_producers: tuple[str, ...] = ()
    """the last ones before `producer`: what comes from them now is old"""

    @property
    def name(self) -> FanName:
        """Tray and fan."""
        return self.tray, self.fan

    @property
    def severity_name(self) -> str:
        """In words, as operators see it."""
        return Severity(self.severity).name

    def to_json(self) -> str:
        """For the outbox."""
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, text: str) -> Self:
        """What `to_json` wrote."""
        values = json.loads(text)
        causes = tuple(NamedCause(**each) for each in values["causes"])
        return cls(**{**values, "causes": causes, "earlier_producers": tuple(values["earlier_producers"])})


def after(before: FanAlarm | None, message: Alarm, now_ns: int) -> FanAlarm | None:
    """The alarm of a fan after a message; None: the message was processed before, or a later one was.

    now_ns: time of the host.
    """
    header = message.header
    earlier = before.earlier_producers if before else ()
    if before and before.producer == header.producer:
        if header.sequence <= before.sequence:
            return None
    elif header.producer in earlier:
        return None
    elif before:
        earlier = (*earlier, before.producer)[-MOST_EARLIER:]
    of_same = before if before and before.onset_t_ns == message.onset_t_ns else None
    presented = is_presented(message)
    first_heard_ns = of_same.first_heard_ns if of_same else 0
    acknowledged_by = of_same.acknowledged_by if of_same else ""
    if message.transition in _NAMES_WHO_ACKNOWLEDGED and message.operator_name:
        acknowledged_by = message.operator_name
    deviation, deviation_t_ns = (of_same.deviation, of_same.deviation_t_ns) if of_same else ("", 0)
    if message.transition in _WITH_DEVIATION:
        deviation_t_ns = message.t_ns
        deviation = message.message.removeprefix(f"fan {message.fan}: ").partition("; ")[0]
    return FanAlarm(
        tray=header.tray,
        fan=message.fan,
        producer=header.producer,
        sequence=header.sequence,
        onset_t_ns=message.onset_t_ns,
        first_heard_ns=first_heard_ns or (now_ns if presented and message.active else 0),
        active=message.active,
        severity=int(message.severity),
        acknowledged=message.acknowledged,
        acknowledged_by=acknowledged_by if message.acknowledged else "",
        presented=presented,
        silenced=is_silenced(message),
        stale=message.stale,
        deviation=deviation,
        causes=tuple(NamedCause(each.cause, each.probability, each.evidence) for each in message.causes),
        deviation_t_ns=deviation_t_ns,
        earlier_producers=earlier,
    )


def heard_at(alarm: FanAlarm, now_ns: int) -> FanAlarm:
    """The same, first heard now if it was not before."""
    return alarm if alarm.first_heard_ns else replace(alarm, first_heard_ns=now_ns)
