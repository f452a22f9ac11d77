"""The groups that all outputs sort fans into: page, API, MQTT and metrics count the same fans as in alarm.

A fan is in alarm as long as its alarm is active and no operator has silenced it, whatever its newest sample says.
"""

from __future__ import annotations

from enum import StrEnum
from typing import NamedTuple

import numpy as np

from fantwin.pipeline.site.fleet import NORMAL_LEVELS, Fleet, class_names
from fantwin.schemas.enums import FanState
from fantwin.schemas.messages import Array
from fantwin.scoring.alarms.words_now import words_now


class FanGroup(StrEnum):
    """The worst first."""

    ALARM = "alarm"
    SUSPECT = "suspect"
    NOT_JUDGED = "not_judged"
    SILENCED = "silenced"
    AT_REST = "at_rest"
    NORMAL = "normal"


_OF_STATE = {
    FanState.NORMAL: FanGroup.NORMAL,
    FanState.SUSPECT: FanGroup.SUSPECT,
    FanState.ALARM: FanGroup.ALARM,
    FanState.RETURNING: FanGroup.ALARM,
    FanState.STOPPED: FanGroup.AT_REST,
    FanState.STARTING: FanGroup.AT_REST,
}
"""of a fan whose alarm is not active by its messages; others are not judged"""
_BARE_ALARM = (FanState.NORMAL, FanState.SUSPECT, FanState.ALARM)
"""states that add nothing to an active alarm"""


class ShownClass(NamedTuple):
    """What a cell of a class shows: name and group. now: what a fan with an alarm does now; empty: nothing to say."""

    name: str
    group: FanGroup
    now: str


def _shown_classes() -> list[ShownClass]:
    """The classes of the fleet, then those of fans in alarm, then those of fans whose alarm is silenced."""
    bare: list[ShownClass] = []
    active: list[ShownClass] = []
    for number, name in enumerate(class_names()):
        value = number - NORMAL_LEVELS
        state = FanState.NORMAL if value < 0 else FanState(value) if value < len(FanState) else FanState.UNKNOWN
        now = words_now(state)
        bare.append(ShownClass(name, _OF_STATE.get(state, FanGroup.NOT_JUDGED), now))
        added = "" if state in _BARE_ALARM else f", now {now.partition(' (')[0]}" if now else f", {name}"
        active.append(ShownClass(f"alarm{added}", FanGroup.ALARM, now))
    return [
        *bare,
        *active,
        *(each._replace(name=f"{each.name} (silenced)", group=FanGroup.SILENCED) for each in active),
    ]


SHOWN_CLASSES = _shown_classes()
_GROUPS = np.array([list(FanGroup).index(each.group) for each in SHOWN_CLASSES])


def classes_of(fleet: Fleet) -> Array:
    """The class of each fan, (fans,) uint8, an index into `SHOWN_CLASSES`."""
    count = len(class_names())
    in_alarm = fleet.in_alarm()
    return (fleet.classes() + count * in_alarm + count * (in_alarm & fleet.silenced())).astype(np.uint8)


def counts_of(classes: Array) -> dict[FanGroup, int]:
    """How many fans are in each group."""
    found = np.bincount(_GROUPS[classes], minlength=len(FanGroup))
    return dict(zip(FanGroup, found.tolist(), strict=True))
