"""The table of alarms: the fans whose alarm operators should see or have silenced, the active ones first."""

from __future__ import annotations

import re
from collections.abc import Sequence

from fantwin.pipeline.outputs.rerun.alarm_log import clock_utc, cut, exceeded
from fantwin.scoring.alarms.alarm_flags import is_listed, is_silenced
from fantwin.scoring.alarms.current_alarms import CurrentAlarm
from fantwin.scoring.diagnosis.causes import most_probable

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
    name = markdown_literal(cut(f"{alarm.header.tray}/{alarm.fan}", NAME_LENGTH))
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
