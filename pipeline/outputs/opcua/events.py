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

from fantwin.pipeline.config.settings import TrayConfig
from fantwin.pipeline.outputs.opcua.conditions import condition_fields
from fantwin.pipeline.outputs.opcua.encoding import localized, standard, string, value_of
from fantwin.pipeline.outputs.opcua.event_filter import CONDITION_ID, path_of
from fantwin.pipeline.outputs.opcua.identifiers import SITE_FOLDER, condition_identifier
from fantwin.pipeline.site.fleet import Fan
from fantwin.scoring.alarms.current_alarms import CurrentAlarm

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
