"""Flags of an alarm that say whether it needs attention: retained, silenced, presented, listed (OPC UA Part 9).

This is the only definition. The scorer's `AlarmState` and the `Alarm` message carry the same flags; both are accepted.
"""

from __future__ import annotations

from fantwin.schemas.messages import Alarm
from fantwin.scoring.alarms.alarm_state import AlarmState


def is_retained(alarm: Alarm | AlarmState) -> bool:
    """Return whether the alarm still needs attention (Retain, 5.5.2): active, latched, unacknowledged or
    unconfirmed."""
    return alarm.active or alarm.latched or not (alarm.acknowledged and alarm.confirmed)


def is_silenced(alarm: Alarm | AlarmState) -> bool:
    """Return whether an operator has silenced the alarm (SuppressedOrShelved, 5.8.2): shelved, suppressed, out of
    service."""
    return bool(alarm.shelved_until_t_ns) or alarm.suppressed or alarm.out_of_service


def is_presented(alarm: Alarm | AlarmState) -> bool:
    """Return whether operators should see the alarm: retained and not silenced."""
    return is_retained(alarm) and not is_silenced(alarm)


def is_listed(alarm: Alarm | AlarmState) -> bool:
    """Return whether the alarm belongs on a list of current alarms: retained or silenced."""
    return is_retained(alarm) or is_silenced(alarm)
