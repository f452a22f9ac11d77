"""What holds for every kind of source. A new kind needs a row in tests/support/source_worlds.py, and is held to it."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path

import pytest

from fantwin.pipeline.sources import polling
from fantwin.pipeline.sources.http import source as http_source
from fantwin.pipeline.sources.kinds import SOURCE_KINDS, build_source, parse_source
from fantwin.pipeline.sources.mqtt import client as broker_client
from fantwin.pipeline.sources.serial import port as serial_port
from fantwin.pipeline.sources.snmp import source as snmp_source
from fantwin.pipeline.sources.source import (
    LinkDown,
    LinkUp,
    Reading,
    ReadingBatch,
    SourceContext,
)
from tests.support.delivered import Delivered
from tests.support.running_chain import eventually
from tests.support.source_worlds import WORLDS, World, speeds_of

every_kind = pytest.mark.parametrize("kind", SOURCE_KINDS)
SEVERAL_ATTEMPTS_S = 0.3
"""time in which a source may try again and again; no test needs it to"""


class Running:
    """A source, the far end of it, and what it has delivered."""

    def __init__(self, kind: str, world: World) -> None:
        self.world = world
        config = parse_source({"kind": kind, **world.settings})
        self.source = build_source(config, SourceContext(2, "rpm", world.folder, "tray1"))
        self.events = Delivered()

    def start(self) -> None:
        self.source.start(self.events.append)

    def show(self, number: int) -> Reading:
        """The reading of a sample that the device shows."""
        self.world.show(number, self.source, self.events.append)
        wanted = speeds_of(number)
        eventually(
            lambda: any(reading.speed == pytest.approx(wanted) for reading in self.events.readings), f"{number} came"
        )
        return next(reading for reading in self.events.readings if reading.speed == pytest.approx(wanted))

    def wait_for_link(self, kind: type[LinkUp | LinkDown]) -> None:
        eventually(
            lambda: self.events.links and isinstance(self.events.links[-1], kind), f"the link is {kind.__name__}"
        )


@pytest.fixture
def made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[str], Running]]:
    """Makes a source whose device is not plugged in yet; attempts to reach it follow one another quickly."""
    for module, names in (
        (polling, ("RECONNECT_DELAY_S", "RECONNECT_DELAY_MAX_S")),
        (serial_port, ("REOPEN_DELAY_S", "REOPEN_DELAY_MAX_S")),
        (http_source, ("RETRY_S",)),
        (snmp_source, ("TIMEOUT_S",)),
    ):
        for name in names:
            monkeypatch.setattr(module, name, 0.02)
    monkeypatch.setattr(broker_client, "RECONNECT_DELAY_MAX_S", 1)
    running: list[Running] = []

    def make(kind: str) -> Running:
        running.append(Running(kind, WORLDS[kind](tmp_path)))
        return running[-1]

    yield make
    for each in running:
        each.source.stop()
        each.world.stack.close()


@every_kind
def test_readings_come_in_order_as_the_device_gave_them(kind: str, made: Callable[[str], Running]) -> None:
    running = made(kind)
    running.world.plug_in()
    running.start()
    running.wait_for_link(LinkUp)
    assert isinstance(running.events[0], LinkUp)
    for number in range(1, 6):
        assert running.show(number).command == pytest.approx((running.world.command,) * 2)
    batches = [event for event in running.events if isinstance(event, ReadingBatch)]
    received = [each.received_t_ns for each in batches if any(isinstance(item, Reading) for item in each.items)]
    assert received == sorted(received)
    numbers = [each.sequence for each in running.events.readings if each.sequence is not None]
    assert all(later > earlier for earlier, later in pairwise(numbers))
    clocks_us = [each.clock_us for each in running.events.readings if each.clock_us is not None]
    assert all(0 < (later - earlier) % 2**32 < 2**31 for earlier, later in pairwise(clocks_us))


@every_kind
def test_what_is_no_sample_is_counted_with_a_reason_and_costs_no_other(
    kind: str, made: Callable[[str], Running]
) -> None:
    running = made(kind)
    running.world.plug_in()
    running.start()
    running.wait_for_link(LinkUp)
    running.show(1)
    running.world.garble(running.source, running.events.append)
    eventually(lambda: running.events.refused, "it is refused")
    refused = running.events.refused[0]
    assert refused.kind and refused.detail and "\n" not in refused.detail
    running.show(2)


@pytest.mark.parametrize("kind", [kind for kind in SOURCE_KINDS if kind != "push"])  # the bus is always there
def test_a_device_that_is_gone_is_reported_in_one_line_and_found_again(
    kind: str, made: Callable[[str], Running]
) -> None:
    running = made(kind)
    assert not any("\n" in problem for problem in running.source.check())
    running.start()
    running.wait_for_link(LinkDown)
    threading.Event().wait(SEVERAL_ATTEMPTS_S)
    if running.world.says_once:
        assert len(running.events.links) == 1
    running.world.plug_in()
    running.wait_for_link(LinkUp)
    running.show(1)
    if running.world.dies:
        running.world.unplug()
        running.wait_for_link(LinkDown)
        running.world.plug_in()
        running.wait_for_link(LinkUp)
        running.show(2)
    for link in running.events.links:
        assert isinstance(link, LinkUp) or (link.reason and "\n" not in link.reason)


@every_kind
def test_a_source_that_was_stopped_delivers_nothing_and_needs_no_device_to_end(
    kind: str, made: Callable[[str], Running]
) -> None:
    running = made(kind)
    running.start()
    eventually(lambda: running.events, "it is connected, or not")
    running.world.plug_in()
    running.source.stop()
    delivered = len(running.events)
    if kind != "push":  # which gets its samples from acquisition, and after stop there is none
        running.world.show(1, running.source, running.events.append)
    threading.Event().wait(0.1)
    assert len(running.events) == delivered


@every_kind
def test_a_command_that_reaches_no_device_is_answered_with_the_reason(
    kind: str, made: Callable[[str], Running]
) -> None:
    reason = made(kind).source.send((0.5, 0.5), ())
    assert reason and "\n" not in reason


@every_kind
def test_where_its_device_is_there_nothing_keeps_it_from_connecting(kind: str, made: Callable[[str], Running]) -> None:
    running = made(kind)
    running.world.plug_in()
    assert running.source.check() == []
    assert running.source.name


@every_kind
def test_settings_are_frozen_and_an_unknown_one_is_refused_by_name(kind: str, made: Callable[[str], Running]) -> None:
    settings = {"kind": kind, **made(kind).world.settings}
    config = parse_source(settings)
    assert config.kind == kind and parse_source(config.model_dump()) == config
    with pytest.raises(ValueError, match="no_such_key"):
        parse_source({**settings, "no_such_key": 1})
    with pytest.raises(ValueError, match="frozen"):
        config.kind = "other"  # pyright: ignore[reportAttributeAccessIssue]
