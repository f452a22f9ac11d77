"""The lines of the alarm log, and the table of the fans whose alarm operators should see or have silenced."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from fantwin.pipeline.recordings.dates import has_date
from fantwin.schemas.enums import Severity, Statistic, Transition
from fantwin.schemas.fan_names import fan_cell
from fantwin.schemas.messages import Alarm
from fantwin.schemas.units import NS_PER_S
from fantwin.scoring.alarms.alarm_state import UNTIL_IT_CLEARS_T_NS, is_listed, is_silenced
from fantwin.scoring.alarms.alarm_text import TRANSITIONS
from fantwin.scoring.alarms.current_alarms import CurrentAlarm
from fantwin.scoring.diagnosis.causes import CANNOT_TELL, most_probable, with_share

LINE_LENGTH = 64
"""a longer line is cut"""
_EXCEEDED = {
    Statistic.STANDSTILL: "does not turn as commanded",
    Statistic.MISSING_READINGS: "the tacho loses readings",
    Statistic.WEAR: "a slow change has reached its limit",
}


class LogLine(NamedTuple):
    """One line; `t_ns` is the time of the sample, ns since the epoch, `level` INFO, WARN or ERROR."""

    tray: str
    t_ns: int
    level: str
    text: str


def log_line(alarm: Alarm) -> LogLine:
    """The line about an alarm's transition."""
    level = "INFO"
    is_bad = alarm.active or alarm.transition != Transition.REPUBLISHED
    if is_bad and alarm.transition in (Transition.RAISED, Transition.SEVERITY, Transition.REPUBLISHED):
        level = "ERROR" if alarm.severity == Severity.ALARM else "WARN"
    text = f"{alarm.label}: {_what_happened(alarm)}"
    return LogLine(alarm.header.tray, alarm.t_ns, level, cut(text, LINE_LENGTH))


def cut(text: str, length: int) -> str:
    """The text on one line, at most so long."""
    text = " ".join(text.split())
    return text if len(text) <= length else f"{text[: length - 1].rstrip()}…"


def _what_happened(alarm: Alarm) -> str:
    transition, by = alarm.transition, f" by {alarm.operator_name}" if alarm.operator_name else ""
    if transition in (Transition.RAISED, Transition.SEVERITY):
        return f"{alarm.severity.words} {transition.words}, {exceeded(alarm)}"
    if transition == Transition.DIAGNOSED and alarm.causes:
        first = alarm.causes[0]
        return with_share(first) if first.cause == CANNOT_TELL else f"probably {with_share(first)}"
    if transition == Transition.REPUBLISHED:
        over = "no alarm" if alarm.severity == Severity.NONE else "back to normal"
        return f"{f'{alarm.severity.words} goes on' if alarm.active else over}, after a restart"
    if transition == Transition.SHELVED:
        ends = alarm.shelved_until_t_ns
        until = "it clears" if ends == UNTIL_IT_CLEARS_T_NS else clock_utc(ends, alarm.t_ns)
        return f"shelved until {until}{by}"
    if transition == Transition.REFUSED:
        return f"request{by} refused: {alarm.message.partition('refused: ')[2] or alarm.message}"
    return f"{TRANSITIONS.get(transition, transition.words)}{by}"


def exceeded(alarm: Alarm) -> str:
    """What raised the alarm: `torque balance off, 1.7 x the limit of the evidence`."""
    if alarm.statistic in _EXCEEDED:
        return _EXCEEDED[alarm.statistic]
    residual = "torque balance" if alarm.torque_balance_command and not alarm.residual_rad_s else "speed"
    return f"{residual} off, evidence {alarm.score:.2g} x its limit"


def clock_utc(t_ns: int, now_t_ns: int) -> str:
    """A time of day in UTC, with the date unless it is that of `now_t_ns`; in seconds if the times are no dates."""
    if not has_date(t_ns):
        return f"{t_ns / NS_PER_S:.1f} s"
    day, clock = np.datetime_as_string(np.datetime64(t_ns, "ns"), unit="s").split("T")
    today = np.datetime_as_string(np.datetime64(now_t_ns, "ns"), unit="D")
    return clock if day == today else f"{day} {clock}"


ALARMS_LISTED = 16
NAME_LENGTH, CAUSE_LENGTH = 24, 40
COLORS = (
    "Violet: measured. Green: the twin and its band of ± 2σ, and the torque balance expected. Red: dots outside the "
    "band, area in alarm, limit of the score. Grey: not scored. A hole: no samples."
)


def alarm_table(current: Sequence[CurrentAlarm], now_t_ns: int) -> str:
    """The table in Markdown. now_t_ns: time of the newest sample."""
    alarms = sorted((each for each in current if is_listed(each.newest)), key=_rank)
    active = sum(each.newest.active for each in alarms)
    lines = [f"#### {active:,} active, {len(alarms) - active:,} over" if alarms else "#### No alarms"]
    if alarms:
        rows = ["| tray/fan | alarm | since (UTC) | probable cause | seen by |", "|:--|:--|:--|:--|:--|"]
        lines.append("\n".join([*rows, *(_row(each, now_t_ns) for each in alarms[:ALARMS_LISTED])]))
    if alarms[ALARMS_LISTED:]:
        lines.append(f"and {len(alarms) - ALARMS_LISTED:,} more: `fantwin alarms` lists them")
    return "\n\n".join([*lines, COLORS])


def _row(each: CurrentAlarm, now_t_ns: int) -> str:
    alarm = each.newest
    state = alarm.severity.words if alarm.active else "over"
    state += ", silenced" if is_silenced(alarm) else ", no data" if alarm.stale and alarm.active else ""
    cause = ", ".join(most_probable(each.causes)) if each.causes else exceeded(alarm) if alarm.active else ""
    seen = each.acknowledged_by or ("yes" if alarm.acknowledged else "nobody")
    name = markdown_literal(cut(f"{alarm.header.tray}/{fan_cell(alarm.fan, alarm.fan_name)}", NAME_LENGTH))
    columns = (
        f"**{name}**" if alarm.active else name,
        state,
        clock_utc(alarm.onset_t_ns, now_t_ns) if alarm.onset_t_ns else "",
        markdown_literal(cut(cause, CAUSE_LENGTH)),
        markdown_literal(cut(seen, NAME_LENGTH)),
    )
    return f"| {' | '.join(columns)} |"


def _rank(each: CurrentAlarm) -> tuple[bool, bool, int, int]:
    """Active first, then those that are not silenced, the most severe, the newest."""
    alarm = each.newest
    return (not alarm.active, is_silenced(alarm), -int(alarm.severity), -alarm.onset_t_ns)


def markdown_literal(text: str) -> str:
    """Text escaped for Markdown, on one line."""
    return re.sub(r"([\\`*_\[\]<>|#~])", r"\\\1", " ".join(text.split()))
