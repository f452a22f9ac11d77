"""Events of conditions: the alarm of a fan as an AlarmCondition of Part 9, what a subscription gets of it, and to whom
it goes.
"""

from __future__ import annotations

import asyncio
import hashlib
import math
import time
import uuid
from collections.abc import Iterable, Iterator, Mapping, Sequence
from datetime import UTC, datetime
from typing import Any

from asyncua import ua
from asyncua.server.subscription_service import SubscriptionService

from fantwin.pipeline.config.settings import TrayConfig
from fantwin.pipeline.outputs.opcua.encoding import (
    FAN_ALARM_TYPE,
    SITE_FOLDER,
    STATUS,
    boolean,
    condition_identifier,
    localized,
    null_or_time,
    standard,
    string,
    value_of,
)
from fantwin.pipeline.site.fleet import Fan
from fantwin.pipeline.site.request_desk import LONGEST_SHELVING_S
from fantwin.schemas.enums import Severity, Transition
from fantwin.schemas.messages import Alarm
from fantwin.scoring.alarms.alarm_state import UNTIL_IT_CLEARS_T_NS, is_retained, is_silenced
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
        "SourceName": string(f"{newest.fan_name} ({fan})" if newest and newest.fan_name else str(fan)),
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
        **_two_state("ActiveState", active, "Active", "Inactive"),
        "ActiveState/EffectiveDisplayName": localized(", ".join(current.states()) if current else "never raised"),
        "ActiveState/TransitionTime": null_or_time(newest.onset_t_ns if newest and active else 0),
        "InputNode": node(ua.NodeId(f"{fan}/Score", namespace)),
        **_two_state("OutOfServiceState", bool(newest and newest.out_of_service), "Out of Service", "In Service"),
        "ShelvingState/CurrentState": localized(shelving),
        "ShelvingState/CurrentState/Id": node(standard(f"ShelvedStateMachineType_{shelving_node}")),
        "ShelvingState/UnshelveTime": value_of(unshelve_ms),
        "SuppressedOrShelved": boolean(newest is not None and is_silenced(newest)),
        "MaxTimeShelved": value_of(LONGEST_SHELVING_S * 1e3),
        "Cause": string(likely_causes(causes)),
        "CauseProbability": value_of(probability),
        "Evidence": string(likely_evidence(causes)),
        "Score": value_of(newest.score if newest else math.nan),
    }


CONDITION_ID = "NodeId"
_OF_REFRESH = ("RefreshStartEventType", "RefreshEndEventType", "RefreshRequiredEventType")
_OF_ALARMS = ("AlarmConditionType", "AcknowledgeableConditionType", "ConditionType", "BaseEventType")
_OF_SYSTEM = ("SystemEventType", "BaseEventType")


def path_of(clause: ua.SimpleAttributeOperand) -> str:
    """The path of a selected field. The node of a condition, its ConditionId, is selected as an attribute."""
    if not clause.BrowsePath:
        return CONDITION_ID if clause.AttributeId == ua.AttributeIds.NodeId else ""
    return "/".join(part.Name for part in clause.BrowsePath)


def as_the_library_evaluates(clause: ua.ContentFilter, namespace: int) -> ua.ContentFilter:
    """The same filter: a field has its path as its name, a type is the list of those of its subtypes that this server
    sends, and the events of a refresh pass. namespace: of the server's own types.

    The library compares types of events for equality, knows no field below another one, and filters the events of a
    refresh too, which every client needs (Part 9, 5.5.7).
    """
    if not clause.Elements:
        return clause
    types = _types(namespace)
    refresh = _is_one_of(standard(name) for name in _OF_REFRESH)
    first = ua.ContentFilterElement(
        FilterOperator=ua.FilterOperator.Or,
        FilterOperands=[ua.ElementOperand(Index=ua.UInt32(1)), ua.ElementOperand(Index=ua.UInt32(2))],
    )
    return ua.ContentFilter(Elements=[first, refresh, *(_element(each, types) for each in clause.Elements)])


def _types(namespace: int) -> Mapping[ua.NodeId, Sequence[ua.NodeId]]:
    """The types that are sent, each with those that it is a subtype of."""
    named = {ua.NodeId(FAN_ALARM_TYPE, namespace): _OF_ALARMS}
    named |= {standard(name): _OF_SYSTEM for name in _OF_REFRESH}
    return {kind: (kind, *(standard(name) for name in above)) for kind, above in named.items()}


def _element(
    element: ua.ContentFilterElement, types: Mapping[ua.NodeId, Sequence[ua.NodeId]]
) -> ua.ContentFilterElement:
    operands = [_operand(each) for each in element.FilterOperands]
    if element.FilterOperator == ua.FilterOperator.OfType and isinstance(operands[0], ua.LiteralOperand):
        wanted = operands[0].Value.Value
        return _is_one_of(kind for kind, above in types.items() if wanted in above)
    return ua.ContentFilterElement(FilterOperator=element.FilterOperator, FilterOperands=operands)


def _operand(operand: Any) -> Any:
    if isinstance(operand, ua.ElementOperand):
        return ua.ElementOperand(Index=ua.UInt32(operand.Index + 2))  # two elements come first
    return _field(path_of(operand)) if isinstance(operand, ua.SimpleAttributeOperand) else operand


def _is_one_of(types: Iterable[ua.NodeId]) -> ua.ContentFilterElement:
    literals = [ua.LiteralOperand(Value=ua.Variant(each, ua.VariantType.NodeId)) for each in types]
    return ua.ContentFilterElement(
        FilterOperator=ua.FilterOperator.InList, FilterOperands=[_field("EventType"), *literals]
    )


def _field(path: str) -> ua.SimpleAttributeOperand:
    return ua.SimpleAttributeOperand(BrowsePath=[ua.QualifiedName(path)], AttributeId=ua.AttributeIds.Value)


_AT_ONCE = 50
"""events that are delivered before others may do something"""


class SiteEvent:
    """What the library asks of an event. Values are those of its fields, by path."""

    def __init__(self, fields: Mapping[str, ua.Variant]) -> None:
        self.fields = fields
        self.emitting_node = ua.NodeId(ua.ObjectIds.Server)

    def __getattr__(self, path: str) -> Any:
        """The value of a field, for a filter; None: the event has no such field."""
        found = self.fields.get(path)
        return found.Value if found is not None else None

    def to_event_fields(self, clauses: Sequence[ua.SimpleAttributeOperand]) -> list[ua.Variant]:
        """The values of what a client has selected; null where this event has no such field."""
        return [self.fields.get(path_of(clause)) or ua.Variant() for clause in clauses]


def condition_event(current: CurrentAlarm, namespace: int) -> SiteEvent:
    """The event of a condition as it is."""
    fan = Fan(current.newest.header.tray, current.newest.fan)
    node = ua.Variant(ua.NodeId(condition_identifier(fan), namespace), ua.VariantType.NodeId)
    return SiteEvent({**condition_fields(fan, current, time.time_ns(), namespace), CONDITION_ID: node})


def system_event(kind: str, message: str) -> SiteEvent:
    """An event of the server itself. kind: name of its type, of the standard."""
    now = ua.Variant(datetime.now(UTC), ua.VariantType.DateTime)
    return SiteEvent(
        {
            "EventId": ua.Variant(uuid.uuid4().bytes, ua.VariantType.ByteString),
            "EventType": ua.Variant(standard(kind), ua.VariantType.NodeId),
            "SourceNode": ua.Variant(standard("Server"), ua.VariantType.NodeId),
            "SourceName": string("Server"),
            "Time": now,
            "ReceiveTime": now,
            "Message": localized(message),
            "Severity": value_of(1, "UInt16"),
        }
    )


class EventDelivery:
    """Sends events to the subscriptions of a server: to those of the server, of the site, of a tray and of a fan."""

    def __init__(self, subscriptions: SubscriptionService, namespace: int, trays: Sequence[TrayConfig]) -> None:
        self._subscriptions = subscriptions
        self._namespace = namespace
        self._trays = trays

    async def to_all(self, conditions: Sequence[CurrentAlarm]) -> None:
        """Send the events of these conditions, in their order."""
        await self._send_conditions(conditions, None)

    async def ask_for_refresh(self) -> None:
        """Tell all that events were left out."""
        await self._send(system_event("RefreshRequiredEventType", "events were left out"), self._notifiers(), None)

    async def refresh(self, subscription: int, found: Sequence[CurrentAlarm]) -> None:
        """Send what ConditionRefresh asks for: all conditions that need attention, between a start and an end."""
        await self._send(system_event("RefreshStartEventType", "refresh begins"), self._notifiers(), subscription)
        await self._send_conditions(found, subscription)
        await self._send(system_event("RefreshEndEventType", "refresh ends"), self._notifiers(), subscription)

    async def _send_conditions(self, conditions: Sequence[CurrentAlarm], subscription: int | None) -> None:
        for count, current in enumerate(conditions):
            tray, fan = current.newest.header.tray, current.newest.fan
            notifiers = (*self._of_site(), self._node(tray), self._node(f"{tray}/{fan}"))
            await self._send(condition_event(current, self._namespace), notifiers, subscription)
            if count % _AT_ONCE == _AT_ONCE - 1:
                await asyncio.sleep(0)

    async def _send(self, event: SiteEvent, notifiers: Iterable[ua.NodeId], subscription: int | None) -> None:
        for node in notifiers:
            event.emitting_node = node
            await self._subscriptions.trigger_event(event, subscription)

    def _notifiers(self) -> Iterator[ua.NodeId]:
        """All that can be subscribed to: each of them notifies of what is the server's own."""
        yield from self._of_site()
        for tray in self._trays:
            yield self._node(tray.name)
            yield from (self._node(f"{tray.name}/{number}") for number in range(tray.fans))

    def _of_site(self) -> tuple[ua.NodeId, ua.NodeId]:
        return ua.NodeId(ua.ObjectIds.Server), ua.NodeId(SITE_FOLDER, self._namespace)

    def _node(self, identifier: str) -> ua.NodeId:
        return ua.NodeId(identifier, self._namespace)
