"""Events of conditions: what a subscription gets of them, and to whom they go."""

# pyright: reportPrivateImportUsage=false, reportArgumentType=false
# (the library declares its names and integers otherwise than it uses them)
from __future__ import annotations

import asyncio
import time
import uuid
from collections.abc import Iterable, Iterator, Mapping, Sequence
from datetime import UTC, datetime
from typing import Any

from asyncua import ua
from asyncua.server.subscription_service import SubscriptionService

from fantwin.pipeline.config.models import TrayConfig
from fantwin.pipeline.outputs.opcua.conditions import ALL_FIELDS, Condition
from fantwin.pipeline.outputs.opcua.encoding import variant
from fantwin.pipeline.outputs.opcua.event_filter import CONDITION_ID, path_of
from fantwin.pipeline.outputs.opcua.identifiers import SITE_FOLDER

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


def condition_event(condition: Condition, namespace: int) -> SiteEvent:
    """The event of a condition as it is."""
    values = condition.fields(time.time_ns())
    fields = {path: variant(kind, values[path], namespace) for path, kind in ALL_FIELDS.items()}
    fields[CONDITION_ID] = ua.Variant(ua.NodeId(condition.identifier, namespace), ua.VariantType.NodeId)
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

    def __init__(self, subscriptions: SubscriptionService, namespace: int, trays: Sequence[TrayConfig]) -> None:
        self._subscriptions = subscriptions
        self._namespace = namespace
        self._trays = trays

    async def to_all(self, conditions: Sequence[Condition]) -> None:
        """Send the events of these conditions, in their order."""
        await self._send_conditions(conditions, None)

    async def ask_for_refresh(self) -> None:
        """Tell all that events were left out."""
        await self._send(system_event("RefreshRequiredEventType", "events were left out"), self._notifiers(), None)

    async def refresh(self, subscription: int, found: Sequence[Condition]) -> None:
        """Send what ConditionRefresh asks for: all conditions that need attention, between a start and an end."""
        await self._send(system_event("RefreshStartEventType", "refresh begins"), self._notifiers(), subscription)
        await self._send_conditions(found, subscription)
        await self._send(system_event("RefreshEndEventType", "refresh ends"), self._notifiers(), subscription)

    async def _send_conditions(self, conditions: Sequence[Condition], subscription: int | None) -> None:
        for number, condition in enumerate(conditions):
            fan = condition.fan
            notifiers = (*self._of_site(), self._node(fan.tray), self._node(str(fan)))
            await self._send(condition_event(condition, self._namespace), notifiers, subscription)
            if number % _AT_ONCE == _AT_ONCE - 1:
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
