"""The current alarm of a fan as messages need it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from fantwin.schemas.enums import Severity
from fantwin.schemas.messages import Diagnosis
from fantwin.scoring.alarms.alarm_flags import is_presented, is_silenced
from fantwin.scoring.alarms.alarm_text import deviation_in
from fantwin.scoring.alarms.current_alarms import CurrentAlarm

FanName = tuple[str, int]
"""tray and fan"""


@dataclass(frozen=True, eq=False)
class FanAlarm:
    """What messages say of the alarm of a fan.

    Attributes:
        first_heard_ns: when this occurrence was first presented here, by the clock of the host; 0: not yet.
        deviation: how far the fan is from its twin, as the last message that said so has it; may be empty.
        deviation_t_ns: when that was, by the clock of the device; 0: unknown.
    """

    tray: str
    fan: int
    onset_t_ns: int
    first_heard_ns: int
    active: bool
    severity: int
    acknowledged: bool
    acknowledged_by: str
    presented: bool
    silenced: bool
    stale: bool
    deviation: str
    deviation_t_ns: int
    causes: Sequence[Diagnosis]

    @property
    def name(self) -> FanName:
        """Tray and fan."""
        return self.tray, self.fan

    @property
    def severity_name(self) -> str:
        """In words, as operators see it."""
        return Severity(self.severity).name


def fan_alarm(current: CurrentAlarm, first_heard_ns: int) -> FanAlarm:
    """The alarm of a fan for its messages."""
    alarm, raised = current.newest, current.raised
    return FanAlarm(
        tray=alarm.header.tray,
        fan=alarm.fan,
        onset_t_ns=alarm.onset_t_ns,
        first_heard_ns=first_heard_ns,
        active=alarm.active,
        severity=int(alarm.severity),
        acknowledged=alarm.acknowledged,
        acknowledged_by=current.acknowledged_by,
        presented=is_presented(alarm),
        silenced=is_silenced(alarm),
        stale=alarm.stale,
        deviation=deviation_in(raised.message, alarm.fan) if raised else "",
        deviation_t_ns=raised.t_ns if raised else 0,
        causes=current.causes,
    )
