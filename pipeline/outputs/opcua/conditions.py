"""The alarm of a fan as an AlarmCondition of Part 9: which field has which value. No OPC UA library is needed here."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

from fantwin.pipeline.outputs.opcua.identifiers import FAN_ALARM_TYPE, condition_identifier
from fantwin.pipeline.site.fleet import Fan
from fantwin.pipeline.site.request_form import LONGEST_SHELVING_S
from fantwin.schemas.enums import Severity, Transition
from fantwin.schemas.messages import Alarm
from fantwin.scoring.alarms.alarm_flags import is_retained, is_silenced
from fantwin.scoring.alarms.current_alarms import CurrentAlarm, current_alarm
from fantwin.scoring.alarms.fan_condition import UNTIL_IT_CLEARS_T_NS
from fantwin.scoring.diagnosis.causes import CANNOT_TELL, likely_causes, likely_evidence

SEVERITIES = {Severity.NONE: 1, Severity.WARNING: 500, Severity.ALARM: 900}
"""of Part 5: 401 to 600 is medium, 801 to 1000 high"""
CONDITION_NAME = "FanAlarm"
UNCERTAIN = "UncertainNoCommunicationLastUsableValue"
NS_PER_MS = 1e6


class StandardNode(NamedTuple):
    """A node of the standard, by the name of its identifier."""

    name: str


class OwnNode(NamedTuple):
    """A node of this server, by its identifier; empty: no node."""

    identifier: int | str


class Time(NamedTuple):
    """Since the epoch; 0: none."""

    t_ns: int


FIELDS: dict[str, str] = {
    "EventId": "ByteString",
    "EventType": "NodeId",
    "SourceNode": "NodeId",
    "SourceName": "String",
    "Time": "DateTime",
    "ReceiveTime": "DateTime",
    "Message": "LocalizedText",
    "Severity": "UInt16",
    "ConditionClassId": "NodeId",
    "ConditionClassName": "LocalizedText",
    "ConditionName": "String",
    "BranchId": "NodeId",
    "Retain": "Boolean",
    "EnabledState": "LocalizedText",
    "EnabledState/Id": "Boolean",
    "Quality": "StatusCode",
    "Quality/SourceTimestamp": "DateTime",
    "LastSeverity": "UInt16",
    "LastSeverity/SourceTimestamp": "DateTime",
    "Comment": "LocalizedText",
    "Comment/SourceTimestamp": "DateTime",
    "ClientUserId": "String",
    "AckedState": "LocalizedText",
    "AckedState/Id": "Boolean",
    "ConfirmedState": "LocalizedText",
    "ConfirmedState/Id": "Boolean",
    "ActiveState": "LocalizedText",
    "ActiveState/Id": "Boolean",
    "ActiveState/EffectiveDisplayName": "LocalizedText",
    "ActiveState/TransitionTime": "DateTime",
    "InputNode": "NodeId",
    "SuppressedState": "LocalizedText",
    "SuppressedState/Id": "Boolean",
    "OutOfServiceState": "LocalizedText",
    "OutOfServiceState/Id": "Boolean",
    "ShelvingState/CurrentState": "LocalizedText",
    "ShelvingState/CurrentState/Id": "NodeId",
    "ShelvingState/UnshelveTime": "Double",
    "SuppressedOrShelved": "Boolean",
    "MaxTimeShelved": "Double",
    "LatchedState": "LocalizedText",
    "LatchedState/Id": "Boolean",
}
"""of a condition and of its events: the path of each, and its built-in type"""
OWN_FIELDS: dict[str, str] = {
    "Cause": "String",
    "CauseProbability": "Double",
    "Evidence": "String",
    "Score": "Double",
}
"""that no standard names; the event type `FanAlarmType` has them"""
ALL_FIELDS = FIELDS | OWN_FIELDS


@dataclass(frozen=True, eq=False)
class Condition:
    """The condition of one fan after its newest message, or before any."""

    fan: Fan
    current: CurrentAlarm | None = None

    @property
    def retain(self) -> bool:
        """Whether it still needs attention."""
        return self.current is not None and is_retained(self.current.newest)

    @property
    def identifier(self) -> str:
        """Of its node, which is the ConditionId."""
        return condition_identifier(self.fan)

    def fields(self, now_ns: int) -> Mapping[str, Any]:
        """The value of each of `ALL_FIELDS`. now_ns: host time, for what remains of a shelving."""
        return _fields(self, now_ns)


def event_id(alarm: Alarm) -> bytes:
    """Of the event of a transition: the same in every server, before and after a restart, live and in the history."""
    name = f"{alarm.header.producer}/{alarm.header.tray}/{alarm.fan}/{alarm.header.sequence}"
    return hashlib.sha256(name.encode()).digest()[:16]


def past_condition(alarm: Alarm) -> Condition:
    """The condition as it was after a transition of the history."""
    fan = Fan(alarm.header.tray, alarm.fan)
    return Condition(fan, current_alarm([alarm]))


def _last_severity(alarm: Alarm) -> int:
    """That of before this transition."""
    if alarm.transition in (Transition.RAISED, Transition.NONE):
        return 0
    is_worse = alarm.transition == Transition.SEVERITY
    return SEVERITIES[Severity.WARNING] if is_worse else SEVERITIES.get(alarm.severity, 1)


def _shelving(until_t_ns: int, now_ns: int) -> tuple[str, StandardNode, float]:
    """The state in words, its node, and what remains, ms."""
    if not until_t_ns:
        return "Unshelved", StandardNode("ShelvedStateMachineType_Unshelved"), 0.0
    if until_t_ns == UNTIL_IT_CLEARS_T_NS:
        return "One Shot Shelved", StandardNode("ShelvedStateMachineType_OneShotShelved"), LONGEST_SHELVING_S * 1e3
    remaining_ms = max(0.0, (until_t_ns - now_ns) / NS_PER_MS)
    return "Timed Shelved", StandardNode("ShelvedStateMachineType_TimedShelved"), remaining_ms


def _fields(condition: Condition, now_ns: int) -> dict[str, Any]:
    fan, current = condition.fan, condition.current
    newest, commented = (current.newest, current.commented) if current else (None, None)
    shelving, shelving_node, unshelve_ms = _shelving(newest.shelved_until_t_ns if newest else 0, now_ns)
    active, acked = bool(newest and newest.active), not newest or newest.acknowledged
    confirmed = not newest or newest.confirmed
    suppressed, out = bool(newest and newest.suppressed), bool(newest and newest.out_of_service)
    latched = bool(newest and newest.latched)
    at = Time(newest.t_ns if newest else 0)
    causes = current.causes if current else ()
    probability = causes[0].probability if causes and causes[0].cause != CANNOT_TELL else math.nan
    return {
        "EventId": event_id(newest) if newest else b"",
        "EventType": OwnNode(FAN_ALARM_TYPE),
        "SourceNode": OwnNode(str(fan)),
        "SourceName": str(fan),
        "Time": at,
        "ReceiveTime": Time(now_ns),
        "Message": newest.message if newest else "no alarm has been raised",
        "Severity": SEVERITIES.get(newest.severity, 1) if newest else 1,
        "ConditionClassId": StandardNode("MaintenanceConditionClassType"),
        "ConditionClassName": "Maintenance",
        "ConditionName": CONDITION_NAME,
        "BranchId": OwnNode(""),
        "Retain": condition.retain,
        "EnabledState": "Enabled",
        "EnabledState/Id": True,
        "Quality": UNCERTAIN if newest and newest.stale else "Good",
        "Quality/SourceTimestamp": at,
        "LastSeverity": _last_severity(newest) if newest else 0,
        "LastSeverity/SourceTimestamp": at,
        "Comment": commented.comment if commented else "",
        "Comment/SourceTimestamp": Time(commented.t_ns if commented else 0),
        "ClientUserId": (newest.operator_name if newest else "") or (commented.operator_name if commented else ""),
        "AckedState": "Acknowledged" if acked else "Unacknowledged",
        "AckedState/Id": acked,
        "ConfirmedState": "Confirmed" if confirmed else "Unconfirmed",
        "ConfirmedState/Id": confirmed,
        "ActiveState": "Active" if active else "Inactive",
        "ActiveState/Id": active,
        "ActiveState/EffectiveDisplayName": ", ".join(current.states()) if current else "never raised",
        "ActiveState/TransitionTime": Time(newest.onset_t_ns if newest and active else 0),
        "InputNode": OwnNode(f"{fan}/Score"),
        "SuppressedState": "Suppressed" if suppressed else "Unsuppressed",
        "SuppressedState/Id": suppressed,
        "OutOfServiceState": "Out of Service" if out else "In Service",
        "OutOfServiceState/Id": out,
        "ShelvingState/CurrentState": shelving,
        "ShelvingState/CurrentState/Id": shelving_node,
        "ShelvingState/UnshelveTime": unshelve_ms,
        "SuppressedOrShelved": bool(newest and is_silenced(newest)),
        "MaxTimeShelved": LONGEST_SHELVING_S * 1e3,
        "LatchedState": "Latched" if latched else "Unlatched",
        "LatchedState/Id": latched,
        "Cause": likely_causes(causes),
        "CauseProbability": probability,
        "Evidence": likely_evidence(causes),
        "Score": newest.score if newest else math.nan,
    }
