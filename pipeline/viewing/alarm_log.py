"""The lines of the alarm log."""

from __future__ import annotations

from typing import NamedTuple

from schemas.enums import Severity, Transition
from schemas.messages import Alarm
from scoring.alarms.current_alarms import words_of


class LogLine(NamedTuple):
    """One line; `t_ns` is the time of the sample, ns since the epoch, `level` INFO, WARN or ERROR."""

    tray: str
    t_ns: int
    level: str
    text: str


def log_line(alarm: Alarm) -> LogLine:
    """The line about an alarm's transition."""
    level, happened = "INFO", alarm.transition.words
    is_bad = alarm.active or alarm.transition != Transition.REPUBLISHED
    if is_bad and alarm.transition in (Transition.RAISED, Transition.SEVERITY, Transition.REPUBLISHED):
        level = "ERROR" if alarm.severity == Severity.ALARM else "WARN"
        happened = f"{alarm.severity.words} {happened}"
    return LogLine(alarm.header.tray, alarm.t_ns, level, f"{happened}: {words_of(alarm)}")
