"""Texts of devices, stages and operators as one visible line, for terminals, pages and mails."""

from __future__ import annotations

import re
from dataclasses import replace

from fantwin.schemas.health import Health, Sweep
from fantwin.schemas.messages import Alarm

LONGEST_TEXT, MOST_CAUSES = 2000, 20
"""of an alarm: the rest is cut off"""
_NOT_SHOWN = re.compile(r"[\x00-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069]")
"""characters that end a line, move the cursor of a terminal, or turn the direction of what follows"""


def one_line(text: str) -> str:
    """The text with a space for each character that would not be seen as itself."""
    return _NOT_SHOWN.sub(" ", text)


def _short_line(text: str) -> str:
    return one_line(text[:LONGEST_TEXT])


def readable_alarm(alarm: Alarm) -> Alarm:
    """The alarm with texts that are safe to show and to keep: whoever may publish on the bus chooses them."""
    return replace(
        alarm,
        message=_short_line(alarm.message),
        fan_name=_short_line(alarm.fan_name),
        operator_name=_short_line(alarm.operator_name),
        comment=_short_line(alarm.comment),
        feedback_by=_short_line(alarm.feedback_by),
        feedback_reason=_short_line(alarm.feedback_reason),
        causes=tuple(
            replace(each, cause=_short_line(each.cause), evidence=_short_line(each.evidence))
            for each in alarm.causes[:MOST_CAUSES]
        ),
    )


def _readable_sweep(sweep: Sweep) -> Sweep:
    plan, running, ended = map(_short_line, (sweep.plan, sweep.running, sweep.ended))
    return replace(sweep, plan=plan, running=running, ended=ended)


def readable_health(health: Health) -> Health:
    """The health with a problem and notes that are safe to show."""
    notes = tuple(replace(note, text=one_line(note.text)) for note in health.notes)
    learning = tuple(
        replace(
            each,
            what=one_line(each.what),
            helps=one_line(each.helps),
            fans=tuple(replace(fan, missing=one_line(fan.missing)) for fan in each.fans),
            sweep=each.sweep and _readable_sweep(each.sweep),
        )
        for each in health.learning
    )
    return replace(health, problem=one_line(health.problem), notes=notes, learning=learning)
