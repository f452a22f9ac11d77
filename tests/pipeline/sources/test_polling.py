"""Sources that are asked: times, failures, lateness, reconnection, and writing, with devices that misbehave."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest

from fantwin.pipeline.sources import polling
from fantwin.pipeline.sources.polling import DeviceError, PollingSource
from fantwin.pipeline.sources.source import LinkDown, LinkUp, Reading, ReadingBatch, SourceConfig, SourceEvent
from tests.support.delivered import Delivered
from tests.support.running_chain import DEADLINE_S

PERIOD_S = 0.02


class Device(PollingSource):
    """Does what a list of actions says, one for each reading; the last one goes on."""

    def __init__(self, *actions: Callable[[], float], period_s: float = PERIOD_S) -> None:
        super().__init__(SourceConfig.model_construct(), period_s)
        self.actions = list(actions) or [lambda: 1.0]
        self.connected = self.disconnected = 0
        self.written: list[tuple[float, ...]] = []

    @property
    def name(self) -> str:
        return "device"

    @property
    def settings_to_check(self) -> str:
        return ""

    def connect(self) -> None:
        self.connected += 1

    def read(self) -> Reading:
        action = self.actions.pop(0) if len(self.actions) > 1 else self.actions[0]
        return Reading((0.5,), (action(),))

    def write(self, command: tuple[float, ...]) -> None:
        if math.isinf(command[0]):
            raise DeviceError("not allowed")
        self.written.append(command)

    def disconnect(self) -> None:
        self.disconnected += 1


def failing(reason: str = "timeout", **how: Any) -> Callable[[], float]:
    def fail() -> float:
        raise DeviceError(reason, **how)

    return fail


def polled(device: Device, until: Callable[[Delivered], bool], limit_s: float = DEADLINE_S) -> Delivered:
    """The events up to the one with which `until` holds."""
    events = Delivered()
    is_there = threading.Event()

    def deliver(event: SourceEvent) -> None:
        events.append(event)
        if until(events):
            is_there.set()

    device.start(deliver)
    assert is_there.wait(limit_s)
    device.stop()
    assert device.connected == device.disconnected, "each connection is left in order"
    return events


@pytest.fixture(autouse=True)
def _short_delays(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(polling, "RECONNECT_DELAY_S", 0.01)


def test_the_time_of_a_reading_is_the_middle_of_its_request(monkeypatch: pytest.MonkeyPatch) -> None:
    ahead_s = 0.0
    monkeypatch.setattr(polling, "time", SimpleNamespace(monotonic=lambda: time.monotonic() + ahead_s))
    asked_s: list[float] = []

    def slow() -> float:
        nonlocal ahead_s
        asked_s.append(time.monotonic() + ahead_s)
        ahead_s += 100.0
        return 2.0

    events = polled(Device(slow), lambda found: len(found.readings) == 2)
    for reading, began_s in zip(events.readings, asked_s, strict=False):
        assert reading.clock_us is not None
        after_s = ((reading.clock_us - began_s * 1e6) % 2**32) / 1e6
        assert 49.0 < after_s < 60.0, "half of 100 s, on any machine"


def test_a_poll_that_fails_is_a_gap_in_the_sequence_and_counted() -> None:
    device = Device(lambda: 1.0, failing(), failing(), lambda: 3.0)
    events = polled(device, lambda found: len(found.readings) == 2)
    assert [each.kind for each in events.refused].count("failed_polls") == 2
    first, second = events.readings[:2]
    assert first.sequence == 0 and second.sequence is not None and second.sequence >= 3


def test_a_device_that_keeps_failing_is_lost_or_fails_unexpectedly_is_a_link_down_with_one_line_and_comes_back() -> (
    None
):
    def broken() -> float:
        raise KeyError("Fans")

    three = [failing("no answer")] * 3
    lost = (failing("gone", is_lost=True), lambda: 3.0, broken, lambda: 4.0)
    device = Device(lambda: 1.0, *three, failing("still none"), lambda: 2.0, *lost)
    events = polled(device, lambda found: len(found.readings) == 4)
    assert events.links == [
        LinkUp(),
        LinkDown("no answer"),
        LinkDown("still none"),
        LinkUp(),
        LinkDown("gone"),
        LinkUp(),
        LinkDown("unexpected KeyError: 'Fans'; waiting for it"),
        LinkUp(),
    ]


def test_a_device_is_not_asked_again_before_its_error_allows_it() -> None:
    """Controllers lock users out whose password is refused again and again."""
    device, began_s = Device(failing("refused", is_lost=True, retry_s=0.3), lambda: 1.0), time.monotonic()
    polled(device, lambda found: len(found.readings) == 1)
    assert time.monotonic() - began_s >= 0.3


def test_polls_that_are_late_are_left_out_and_counted_as_lost() -> None:
    def slow() -> float:
        time.sleep(3.5 * PERIOD_S)
        return 2.0

    events = polled(Device(lambda: 1.0, slow, lambda: 3.0), lambda found: len(found.readings) == 3)
    assert len([each for each in events.refused if each.kind == "skipped_polls"]) >= 3
    sequences = [each.sequence for each in events.readings]
    assert sequences[2] is not None and sequences[2] >= 5


def test_commands_are_written_between_polls_and_the_sender_sees_a_refusal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(polling, "WRITE_WAIT_S", DEADLINE_S)
    source = Device(period_s=10.0)
    assert "not connected" in source.send((0.3,), ())
    up = threading.Event()
    source.start(lambda event: up.set() if isinstance(event, ReadingBatch) else None)
    assert up.wait(DEADLINE_S)
    assert source.send((0.3,), ()) == ""
    assert source.send((math.inf,), ()) == "not allowed"
    assert source.send((), (400.0,)) == "device takes commands, no set-points"
    source.stop()
    assert source.written == [(0.3,)]


def test_stop_does_not_wait_for_the_next_poll_and_delivers_nothing_afterwards() -> None:
    source = Device(period_s=30.0)
    events = Delivered()
    source.start(events.append)
    while len(events) < 2:
        time.sleep(0.001)
    source.stop()
    assert source._thread and not source._thread.is_alive() and source.disconnected == 1
    assert len(events) == 2


def test_a_device_that_is_lost_soon_after_each_connection_is_tried_more_and_more_rarely() -> None:
    began_s: list[float] = []

    def once() -> float:
        began_s.append(time.monotonic())
        return 1.0

    polled(Device(*[once, failing("gone", is_lost=True)] * 6), lambda found: len(found.readings) == 6)
    assert began_s[5] - began_s[4] > 0.16, "delays of 10, 20, 40, 80 and 160 ms"
