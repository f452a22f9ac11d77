"""The history of alarms by OPC UA: what a client asks for and no more is read."""

# pyright: reportPrivateImportUsage=false, reportArgumentType=false
# (the library declares its names and integers otherwise than it uses them)
from __future__ import annotations

import asyncio
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("asyncua")

from asyncua import ua

from fantwin.pipeline.config.settings import TrayConfig
from fantwin.pipeline.outputs.opcua import history
from fantwin.pipeline.outputs.opcua.history import EventHistory
from fantwin.pipeline.site import alarm_history
from fantwin.pipeline.site.alarm_history import AlarmHistory
from fantwin.pipeline.site.site_model import SiteModel
from fantwin.schemas.enums import Transition
from tests.support.notified_alarms import START_NS, TRAY, alarm

NAMESPACE = 2
BEGAN = datetime(2026, 9, 21, 14, 13, 20, tzinfo=UTC)
SERVER = ua.NodeId(ua.ObjectIds.Server)


@pytest.fixture
def events(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Transitions of fans 0 to 9 in turn, one a second, but for one request that was refused; asks for the seconds of
    what is found and of what comes next."""
    store = AlarmHistory(tmp_path / "alarms.sqlite")
    for number in range(40):
        refused = {"transition": Transition.REFUSED} if number == 5 else {}
        store.add(alarm(fan=number % 10, sequence=number, t_ns=START_NS + number * 10**9 + 999, **refused))
    decoded = 0

    decode = alarm_history._decoded

    def counted(data: bytes) -> Any:
        nonlocal decoded
        decoded += 1
        return decode(data)

    monkeypatch.setattr("fantwin.pipeline.site.alarm_history._decoded", counted)
    found = EventHistory(SiteModel("hall", (TrayConfig(name=TRAY, fans=10),), store), NAMESPACE)

    def ask(start: float | None, end: float | None, most: int = 0, node: ua.NodeId = SERVER) -> tuple[Any, Any, int]:
        nonlocal decoded
        decoded = 0
        begin, until = (None if each is None else BEGAN + timedelta(seconds=each) for each in (start, end))
        events, rest = asyncio.run(found.read_event_history(node, begin, until, most, None))
        seconds = [(each.fields["Time"].Value - BEGAN).total_seconds() for each in events]
        return seconds, (rest - BEGAN).total_seconds() if rest else None, decoded

    return ask


def test_a_stretch_of_time_of_the_site_a_tray_and_a_fan_forwards_and_backwards(events):
    assert events(3, 7)[0] == [3, 4, 6, 7], "both ends, without what was refused"
    assert events(7, 3)[0] == [7, 6, 4, 3]
    assert events(None, 3)[0] == [3, 2, 1, 0], "without a start the newest first"
    assert events(38, None)[0] == [38, 39]
    assert events(0, 39, node=ua.NodeId(f"{TRAY}/3", NAMESPACE))[0] == [3, 13, 23, 33]
    assert len(events(0, 39, node=ua.NodeId(TRAY, NAMESPACE))[0]) == 39
    assert events(100, 200)[0] == []
    assert len(events(-60e9, 250e9)[0]) == 39, "at the ends of what a time can be"


def test_no_more_is_read_than_is_asked_for_and_the_rest_is_asked_for_where_it_ended(events, monkeypatch):
    assert events(10, 39, most=2) == ([10, 11], None, 3)
    monkeypatch.setattr(history, "MOST_EVENTS", 8)
    assert events(10, 39) == ([10, 11, 12, 13, 14, 15, 16, 17], 18, 9)
    assert events(18, 39)[0][0] == 18
