"""What is seen of a site from outside."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import pytest

from pipeline.launch.site_watcher import MOST_WATCHED_SESSIONS, SiteWatcher
from schemas.codec import encode
from schemas.messages import Alarm, Header, Health, StageStatus
from schemas.topics import health_key, tray_key
from tests.support.bus_peer import alarm


class StubBus:
    """A bus of one process: the test publishes on it."""

    def __init__(self) -> None:
        self.subscribers: dict[str, Callable[[str, bytes], None]] = {}
        self.kept: list[tuple[str, bytes]] = []

    def subscribe(self, key: str, on_message: Callable[[str, bytes], None]) -> None:
        self.subscribers[key] = on_message

    def watch_alive(self, key: str, on_change: Callable[[str, bool], None]) -> None:
        self.on_alive = on_change

    def recover(self, *_args: Any) -> Iterator[tuple[str, bytes]]:
        yield from self.kept


@pytest.mark.parametrize("name", ["", "other", "tray/../x", "*"])
def test_row_18_bytes_of_a_stranger_are_no_alarm(name):
    bus: Any = StubBus()
    watcher = SiteWatcher(bus, "s")
    receive = bus.subscribers[tray_key("s", "*", "alarm")]
    receive("fantwin/s/tray/alarm", b"")  # all fields at their defaults: it decodes
    receive("fantwin/s/tray/alarm", encode(replace(alarm(0), header=Header("peer", 0, name))))
    bus.kept = [("fantwin/s/tray/alarm", b"")]
    watcher.ask_for_past_alarms()
    assert watcher.alarms() == []


def test_an_alarm_that_is_recovered_is_known():
    bus: Any = StubBus()
    watcher = SiteWatcher(bus, "s")
    bus.kept = [("fantwin/s/tray/alarm", encode(alarm(3)))]
    watcher.ask_for_past_alarms()
    assert [type(each) for each in watcher.alarms()] == [Alarm]


def test_row_11_what_a_launched_session_has_lost_is_not_forgotten_in_a_flood_of_others():
    bus: Any = StubBus()
    watcher = SiteWatcher(bus, "s")
    watcher.add_launched(("recorder", 1))
    for number in range(1, MOST_WATCHED_SESSIONS + 3):
        health = Health(
            header=Header(f"recorder-all-{number}", 0, ""),
            stage="recorder",
            instance="all",
            status=StageStatus.OK,
            t_ns=number,
            uptime_s=0.0,
            lost=int(number == 1),
            process_id=number,
        )
        bus.subscribers[health_key("s", "*", "*")]("fantwin/s/health/recorder/all", encode(health))
    assert watcher.losses() == {"recorder": 1}
    assert watcher.last_health(("recorder", 1)) is not None
    assert watcher.last_health(("recorder", 2)) is None


def test_row_13_a_stage_that_is_restarted_after_its_clock_was_set_back_is_the_latest_session():
    bus: Any = StubBus()
    watcher = SiteWatcher(bus, "s")
    for producer, t_ns, process_id in (("recorder-all-a", 7200, 1), ("recorder-all-b", 3600, 2)):
        health = Health(
            header=Header(producer, 0, ""),
            stage="recorder",
            instance="all",
            status=StageStatus.OK,
            t_ns=t_ns,
            uptime_s=0.0,
            process_id=process_id,
        )
        bus.subscribers[health_key("s", "*", "*")]("fantwin/s/health/recorder/all", encode(health))
    assert [view.health.process_id for view in watcher.stages()] == [2]
