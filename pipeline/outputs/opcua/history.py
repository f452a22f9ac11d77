"""The history of alarms, as event history: each transition that the file of alarms holds."""

# pyright: reportPrivateImportUsage=false, reportArgumentType=false
# (the library declares its names and integers otherwise than it uses them)
from __future__ import annotations

import asyncio
from collections.abc import Sequence
from datetime import datetime
from typing import Any

from asyncua import ua
from asyncua.server.history import HistoryDict

from fantwin.pipeline.outputs.opcua.encoding import fan_of, micros_of, time_of
from fantwin.pipeline.outputs.opcua.events import SiteEvent, condition_event
from fantwin.pipeline.site.site_model import SiteModel
from fantwin.schemas.enums import Transition
from fantwin.schemas.messages import Alarm
from fantwin.scoring.alarms.current_alarms import current_alarm

FIRST_NS, LAST_NS = -(1 << 63), (1 << 63) - 1
MOST_EVENTS = 10_000
"""of one call; the client goes on from where it ended"""


class EventHistory(HistoryDict):
    """History of events, from the alarms that the stage keeps; the library itself keeps nothing.

    The server and the site's folder give all alarms; a tray or a fan gives its own.
    """

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
        return condition_event(current_alarm([alarm]), self._namespace)

    def _transitions(
        self, source: ua.NodeId, stretch: tuple[int, int], most: int, is_backwards: bool
    ) -> Sequence[Alarm]:
        tray, number = "", -1
        if source.NamespaceIndex == self._namespace and isinstance(source.Identifier, str):
            fan = fan_of(source.Identifier)
            tray, number = fan[0] if fan else (source.Identifier, -1)
        return self._model.past.between(*stretch, most, tray=tray, fan=number, is_backwards=is_backwards)
