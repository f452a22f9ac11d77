"""The history of alarms, as event history: each transition that the file of alarms holds."""

# pyright: reportPrivateImportUsage=false, reportArgumentType=false
# (the library declares its names and integers otherwise than it uses them)
from __future__ import annotations

import asyncio
from collections.abc import Sequence
from datetime import datetime, timedelta
from typing import Any

from asyncua import ua
from asyncua.server.history import HistoryStorageInterface

from fantwin.pipeline.outputs.opcua.conditions import past_condition
from fantwin.pipeline.outputs.opcua.encoding import micros_of, time_of
from fantwin.pipeline.outputs.opcua.events import SiteEvent, condition_event
from fantwin.pipeline.outputs.opcua.identifiers import fan_of
from fantwin.pipeline.site.site_model import SiteModel
from fantwin.schemas.enums import Transition
from fantwin.schemas.messages import Alarm

FIRST_NS, LAST_NS = -(1 << 63), (1 << 63) - 1
MOST_EVENTS = 10_000
"""of one call; the client goes on from where it ended"""


class EventHistory(HistoryStorageInterface):
    """Of the server and the site's folder: all alarms; of a tray or a fan: its own."""

    def __init__(self, model: SiteModel, namespace: int) -> None:
        super().__init__()
        self._model = model
        self._namespace = namespace

    async def read_event_history(
        self, source_id: ua.NodeId, start: datetime | None, end: datetime | None, nb_values: int, evfilter: Any
    ) -> tuple[list[Any], datetime | None]:
        """Oldest first if the start is before the end, and newest first without a start. The time says where to go on;
        None: this is all."""
        unset = (None, ua.get_win_epoch())
        since, until = (None if each in unset else each for each in (start, end))
        is_backwards = since is None or (until is not None and until < since)
        low, high = (until, since) if is_backwards and since is not None else (since, until)
        most = min(nb_values or MOST_EVENTS, MOST_EVENTS)
        stretch = (
            FIRST_NS if low is None else max(FIRST_NS, min(LAST_NS, micros_of(low) * 1000)),
            LAST_NS if high is None else max(FIRST_NS, min(LAST_NS, (micros_of(high) + 1) * 1000)),
        )
        found = await asyncio.to_thread(self._transitions, source_id, stretch, most + 1, is_backwards)
        rest = time_of(found[most].t_ns) if len(found) > most and not nb_values else None
        return [self._event(alarm) for alarm in found[:most] if alarm.transition != Transition.REFUSED], rest

    def _event(self, alarm: Alarm) -> SiteEvent:
        return condition_event(past_condition(alarm), self._namespace)

    def _transitions(
        self, source: ua.NodeId, stretch: tuple[int, int], most: int, is_backwards: bool
    ) -> Sequence[Alarm]:
        tray, number = "", -1
        if source.NamespaceIndex == self._namespace and isinstance(source.Identifier, str):
            fan = fan_of(source.Identifier)
            tray, number = fan[0] if fan else (source.Identifier, -1)
        return self._model.alarms_between(*stretch, most, tray=tray, fan=number, is_backwards=is_backwards)

    async def init(self) -> None:
        """Nothing to do."""

    async def stop(self) -> None:
        """The file is the stage's."""

    async def new_historized_node(self, node_id: ua.NodeId, period: timedelta | None, count: int = 0) -> None:
        """No values are kept."""

    async def save_node_value(self, node_id: ua.NodeId, datavalue: ua.DataValue) -> None:
        """No values are kept."""

    async def read_node_history(
        self, node_id: ua.NodeId, start: datetime | None, end: datetime | None, nb_values: int
    ) -> tuple[list[ua.DataValue], datetime | None]:
        """No values are kept."""
        return [], None

    async def new_historized_event(
        self, source_id: ua.NodeId, evtypes: list[Any], period: timedelta | None, count: int = 0
    ) -> None:
        """The stage keeps them."""

    async def save_event(self, event: Any) -> None:
        """The stage keeps them."""
