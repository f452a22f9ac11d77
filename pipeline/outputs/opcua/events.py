"""Events of conditions: what a subscription gets of them, and to whom they go."""

# pyright: reportPrivateImportUsage=false, reportArgumentType=false
# (the library declares its names and integers otherwise than it uses them)
from __future__ import annotations

import asyncio
import time
import uuid
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from typing import Any

from asyncua import ua
from asyncua.server.address_space import AddressSpace
from asyncua.server.internal_subscription import InternalSubscription
from asyncua.server.monitored_item_service import WhereClauseEvaluator

from fantwin.pipeline.outputs.opcua.conditions import ALL_FIELDS, Condition
from fantwin.pipeline.outputs.opcua.encoding import variant
from fantwin.pipeline.outputs.opcua.identifiers import SITE_FOLDER
from fantwin.pipeline.site.fleet import Fan

_AT_ONCE = 50
"""events that are delivered before others may do something"""
_CONDITION_ID = "NodeId"
_OF_REFRESH = [
    ua.NodeId(ua.ObjectIds.RefreshStartEventType),
    ua.NodeId(ua.ObjectIds.RefreshEndEventType),
    ua.NodeId(ua.ObjectIds.RefreshRequiredEventType),
]


class SiteEvent:
    """What the library asks of an event. Values are those of its fields, by path."""

    def __init__(self, fields: Mapping[str, ua.Variant]) -> None:
        self.fields = fields
        self.emitting_node = ua.NodeId(ua.ObjectIds.Server)

    @property
    def EventType(self) -> ua.NodeId:  # noqa: N802  a name of the library
        """Of which type it is."""
        return self.fields["EventType"].Value

    def to_event_fields(self, clauses: Sequence[ua.SimpleAttributeOperand]) -> list[ua.Variant]:
        """The values of what a client has selected; null where this event has no such field."""
        return [self.fields.get(path_of(clause)) or ua.Variant() for clause in clauses]


def path_of(clause: ua.SimpleAttributeOperand) -> str:
    """The path of a selected field. The node of a condition, its ConditionId, is selected as an attribute."""
    if not clause.BrowsePath:
        return _CONDITION_ID if clause.AttributeId == ua.AttributeIds.NodeId else ""
    return "/".join(part.Name for part in clause.BrowsePath)


def condition_event(condition: Condition, namespace: int) -> SiteEvent:
    """The event of a condition as it is."""
    values = condition.fields(time.time_ns())
    fields = {path: variant(kind, values[path], namespace) for path, kind in ALL_FIELDS.items()}
    fields[_CONDITION_ID] = ua.Variant(ua.NodeId(condition.identifier, namespace), ua.VariantType.NodeId)
    return SiteEvent(fields)


def system_event(kind: str, message: str) -> SiteEvent:
    """An event of the server itself. kind: name of its type, of the standard."""
    now = datetime.now(UTC)
    return SiteEvent(
        {
            "EventId": ua.Variant(uuid.uuid4().bytes, ua.VariantType.ByteString),
            "EventType": ua.Variant(ua.NodeId(getattr(ua.ObjectIds, kind)), ua.VariantType.NodeId),
            "SourceNode": ua.Variant(ua.NodeId(ua.ObjectIds.Server), ua.VariantType.NodeId),
            "SourceName": ua.Variant("Server", ua.VariantType.String),
            "Time": ua.Variant(now, ua.VariantType.DateTime),
            "ReceiveTime": ua.Variant(now, ua.VariantType.DateTime),
            "Message": ua.Variant(ua.LocalizedText(message), ua.VariantType.LocalizedText),
            "Severity": ua.Variant(1, ua.VariantType.UInt16),
        }
    )


class EventDelivery:
    """Sends events to the subscriptions of a server: to those of the server, of the site, of a tray and of a fan."""

    def __init__(self, subscriptions: Mapping[int, InternalSubscription], namespace: int) -> None:
        self._subscriptions = subscriptions
        self._namespace = namespace

    async def to_all(self, conditions: Sequence[Condition]) -> None:
        """The events of these conditions, in their order."""
        for number, condition in enumerate(conditions):
            event = condition_event(condition, self._namespace)
            for subscription in list(self._subscriptions.values()):
                await self._send(subscription, event, condition.fan)
            if number % _AT_ONCE == _AT_ONCE - 1:
                await asyncio.sleep(0)

    async def of_server_to_all(self, event: SiteEvent) -> None:
        """An event of the server itself."""
        for subscription in list(self._subscriptions.values()):
            await self._send(subscription, event, None)

    async def refresh(self, subscription: InternalSubscription, item: int | None, found: Sequence[Condition]) -> None:
        """What ConditionRefresh sends: all conditions that need attention, between a start and an end. item: to this
        monitored item alone; None: to all of the subscription."""
        await self._send(subscription, system_event("RefreshStartEventType", "refresh begins"), None, item)
        for number, condition in enumerate(found):
            await self._send(subscription, condition_event(condition, self._namespace), condition.fan, item)
            if number % _AT_ONCE == _AT_ONCE - 1:
                await asyncio.sleep(0)
        await self._send(subscription, system_event("RefreshEndEventType", "refresh ends"), None, item)

    async def _send(
        self, subscription: InternalSubscription, event: SiteEvent, fan: Fan | None, item: int | None = None
    ) -> None:
        items = subscription.monitored_item_srv
        for node in self._notifiers(fan):
            event.emitting_node = node
            watching = items._monitored_events.get(node, ())
            for each in list(watching):
                if item is None or each == item:
                    await items.trigger_event(event, each)

    def _notifiers(self, fan: Fan | None) -> list[ua.NodeId]:
        """Who notifies of an event: of what is the server's own, all do."""
        server, site = ua.NodeId(ua.ObjectIds.Server), ua.NodeId(SITE_FOLDER, self._namespace)
        if fan is None:
            nodes = {
                node for each in self._subscriptions.values() for node in each.monitored_item_srv._monitored_events
            }
            return [server, *(nodes - {server})]
        return [server, site, ua.NodeId(fan.tray, self._namespace), ua.NodeId(str(fan), self._namespace)]


class WhereClause(WhereClauseEvaluator):
    """The filter of an event subscription. That of the library knows no subtypes, and no field below another one."""

    def __init__(self, logger: Any, nodes: AddressSpace, clause: ua.ContentFilter) -> None:
        super().__init__(logger, nodes, clause)
        self._nodes = nodes

    def eval(self, event: SiteEvent) -> bool:
        """Whether an event passes. Those that tell of a refresh always do: a client needs them (Part 9, 5.11)."""
        return event.EventType in _OF_REFRESH or super().eval(event)

    def _eval_el(self, index: int, event: SiteEvent) -> Any:
        element = self.elements[index]
        if element.FilterOperator == ua.FilterOperator.OfType:
            wanted = self._eval_op(element.FilterOperands[0], event)
            return wanted in self._types_of(event.EventType)
        return super()._eval_el(index, event)

    def _eval_op(self, op: Any, event: SiteEvent) -> Any:
        if isinstance(op, ua.SimpleAttributeOperand):
            found = event.fields.get(path_of(op))
            return found.Value if found is not None else None
        return super()._eval_op(op, event)

    def _types_of(self, event_type: ua.NodeId) -> list[ua.NodeId]:
        """The type and all that it is a subtype of."""
        found, has_subtype = [event_type], ua.NodeId(ua.ObjectIds.HasSubtype)
        while (node := self._nodes.get(found[-1])) is not None:
            above = [
                each.NodeId for each in node.references if each.ReferenceTypeId == has_subtype and not each.IsForward
            ]
            if not above or above[0] in found:
                break
            found.append(above[0])
        return found
