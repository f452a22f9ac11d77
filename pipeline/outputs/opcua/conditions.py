"""The alarm of a fan as an AlarmCondition of Part 9: which field has which value."""

# pyright: reportPrivateImportUsage=false, reportArgumentType=false
# (the library declares its names and integers differently from how it uses them)
from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping

from asyncua import ua

from fantwin.pipeline.outputs.opcua.encoding import (
    STATUS,
    boolean,
    localized,
    null_or_time,
    standard,
    string,
    value_of,
)
from fantwin.pipeline.outputs.opcua.identifiers import FAN_ALARM_TYPE
from fantwin.pipeline.site.fleet import Fan
from fantwin.pipeline.site.request_form import LONGEST_SHELVING_S
from fantwin.schemas.enums import Severity, Transition
from fantwin.schemas.messages import Alarm
from fantwin.scoring.alarms.alarm_flags import is_retained, is_silenced
from fantwin.scoring.alarms.alarm_state import UNTIL_IT_CLEARS_T_NS
from fantwin.scoring.alarms.current_alarms import CurrentAlarm
from fantwin.scoring.diagnosis.causes import CANNOT_TELL, likely_causes, likely_evidence

SEVERITIES = {Severity.NONE: 1, Severity.WARNING: 500, Severity.ALARM: 900}
"""of Part 5: 401 to 600 is medium, 801 to 1000 high"""
CONDITION_NAME = "FanAlarm"
OWN_FIELDS = ("Cause", "CauseProbability", "Evidence", "Score")
"""fields that `FanAlarmType` adds to those of the standard"""
UNCERTAIN = "UncertainNoCommunicationLastUsableValue"
NS_PER_MS = 1e6


def event_id(alarm: Alarm) -> bytes:
    """The id of a transition's event: the same in every server, before and after a restart, live and in the history."""
    name = f"{alarm.header.producer}/{alarm.header.tray}/{alarm.fan}/{alarm.header.sequence}"
    return hashlib.sha256(name.encode()).digest()[:16]


def _last_severity(alarm: Alarm) -> int:
    """The severity before this transition."""
    if alarm.transition in (Transition.RAISED, Transition.NONE):
        return 0
    is_worse = alarm.transition == Transition.SEVERITY
    return SEVERITIES[Severity.WARNING] if is_worse else SEVERITIES.get(alarm.severity, 1)


def _shelving(until_t_ns: int, now_ns: int) -> tuple[str, str, float]:
    """The state in words, its node in the state machine of the standard, and what remains, ms."""
    if not until_t_ns:
        return "Unshelved", "Unshelved", 0.0
    if until_t_ns == UNTIL_IT_CLEARS_T_NS:
        return "One Shot Shelved", "OneShotShelved", LONGEST_SHELVING_S * 1e3
    return "Timed Shelved", "TimedShelved", max(0.0, (until_t_ns - now_ns) / NS_PER_MS)


def _two_state(name: str, is_so: bool, words: str, otherwise: str) -> dict[str, ua.Variant]:
    return {name: localized(words if is_so else otherwise), f"{name}/Id": boolean(is_so)}


def condition_fields(fan: Fan, current: CurrentAlarm | None, now_ns: int, namespace: int) -> Mapping[str, ua.Variant]:
    """The value of each field of the condition of a fan, and of its event, by its path.

    Args:
        fan: whose condition it is.
        current: its alarm; None before any.
        now_ns: host time, for what remains of a shelving.
        namespace: index of this server's own nodes.
    """
    newest, commented = (current.newest, current.commented) if current else (None, None)
    shelving, shelving_node, unshelve_ms = _shelving(newest.shelved_until_t_ns if newest else 0, now_ns)
    active, at = bool(newest and newest.active), null_or_time(newest.t_ns if newest else 0)
    severity = SEVERITIES.get(newest.severity, 1) if newest else 1
    causes = current.causes if current else ()
    probability = causes[0].probability if causes and causes[0].cause != CANNOT_TELL else math.nan
    user = (newest.operator_name if newest else "") or (commented.operator_name if commented else "")

    def node(found: ua.NodeId) -> ua.Variant:
        return ua.Variant(found, ua.VariantType.NodeId)

    return {
        "EventId": ua.Variant(event_id(newest) if newest else b"", ua.VariantType.ByteString),
        "EventType": node(ua.NodeId(FAN_ALARM_TYPE, namespace)),
        "SourceNode": node(ua.NodeId(str(fan), namespace)),
        "SourceName": string(str(fan)),
        "Time": at,
        "ReceiveTime": null_or_time(now_ns),
        "Message": localized(newest.message if newest else "no alarm has been raised"),
        "Severity": value_of(severity, "UInt16"),
        "ConditionClassId": node(standard("MaintenanceConditionClassType")),
        "ConditionClassName": localized("Maintenance"),
        "ConditionName": string(CONDITION_NAME),
        "BranchId": node(ua.NodeId()),
        "Retain": boolean(newest is not None and is_retained(newest)),
        **_two_state("EnabledState", True, "Enabled", "Disabled"),
        "Quality": ua.Variant(STATUS[UNCERTAIN if newest and newest.stale else "Good"], ua.VariantType.StatusCode),
        "Quality/SourceTimestamp": at,
        "LastSeverity": value_of(_last_severity(newest) if newest else 0, "UInt16"),
        "LastSeverity/SourceTimestamp": at,
        "Comment": localized(commented.comment if commented else ""),
        "Comment/SourceTimestamp": null_or_time(commented.t_ns if commented else 0),
        "ClientUserId": string(user),
        **_two_state("AckedState", not newest or newest.acknowledged, "Acknowledged", "Unacknowledged"),
        **_two_state("ConfirmedState", not newest or newest.confirmed, "Confirmed", "Unconfirmed"),
        **_two_state("ActiveState", active, "Active", "Inactive"),
        "ActiveState/EffectiveDisplayName": localized(", ".join(current.states()) if current else "never raised"),
        "ActiveState/TransitionTime": null_or_time(newest.onset_t_ns if newest and active else 0),
        "InputNode": node(ua.NodeId(f"{fan}/Score", namespace)),
        **_two_state("SuppressedState", bool(newest and newest.suppressed), "Suppressed", "Unsuppressed"),
        **_two_state("OutOfServiceState", bool(newest and newest.out_of_service), "Out of Service", "In Service"),
        "ShelvingState/CurrentState": localized(shelving),
        "ShelvingState/CurrentState/Id": node(standard(f"ShelvedStateMachineType_{shelving_node}")),
        "ShelvingState/UnshelveTime": value_of(unshelve_ms),
        "SuppressedOrShelved": boolean(newest is not None and is_silenced(newest)),
        "MaxTimeShelved": value_of(LONGEST_SHELVING_S * 1e3),
        **_two_state("LatchedState", bool(newest and newest.latched), "Latched", "Unlatched"),
        "Cause": string(likely_causes(causes)),
        "CauseProbability": value_of(probability),
        "Evidence": string(likely_evidence(causes)),
        "Score": value_of(newest.score if newest else math.nan),
    }
