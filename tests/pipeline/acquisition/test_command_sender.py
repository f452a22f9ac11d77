"""Commands to the fans of a tray: what is sent, and what is said of it."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor, wait
from pathlib import Path

import numpy as np
import pytest

from fantwin.pipeline.acquisition.command_sender import CommandSender, command_of, share_note, why_not_sent
from fantwin.pipeline.acquisition.device_commands import DeviceCommands
from fantwin.pipeline.bus.publisher import Publisher
from fantwin.pipeline.bus.session import Bus
from fantwin.pipeline.config.settings import BusConfig, TrayConfig
from fantwin.pipeline.runtime.sessions import Session
from fantwin.pipeline.sources.kinds import build_source
from fantwin.pipeline.sources.serial.config import SerialConfig
from fantwin.pipeline.sources.source import SourceContext
from fantwin.schemas.codec import encode, type_name
from fantwin.schemas.health import Counter, Health, Note
from fantwin.schemas.topics import BY_NAME, alive_key, health_key
from tests.support import made_messages


def test_the_process_that_has_the_tray_answers_whatever_it_is_called(endpoint):
    def session(number: int, *trays: str) -> Session:
        return Session("acquisition", f"{number}-of-2", number, f"acquisition-{number}-of-2-1", "board", number, trays)

    def beat(session: Session, publisher: Publisher) -> None:
        health = made_messages.health(session.stage, session.instance, session.producer, publisher.published)
        publisher.put(encode(health))

    config, stop = BusConfig(endpoint=endpoint), threading.Event()
    with Bus(config) as site, Bus(config, listens=False) as ours, ThreadPoolExecutor(1) as pool:
        site.wait_for_others(stop)
        beating: list[tuple[Session, Publisher]] = []
        for each in (session(1, "a", "c"), session(2, "b")):
            site.declare_alive(each.key("plant"))
            site.declare_alive(alive_key("plant", each.stage, each.instance))
            key = health_key("plant", each.stage, each.instance)
            beating.append((each, site.publisher(key, BY_NAME["health"], type_name(Health), each.producer)))
        sender = CommandSender(ours, "plant", "c", stop)
        connecting = pool.submit(sender.connect)
        while not connecting.done():  # as stages do: a health may be published before it is listened to
            for each, publisher in beating:
                beat(each, publisher)
            wait([connecting], timeout=0.1)
        connecting.result()
        answers = sender._acquisition.health()
    assert answers
    assert answers.header.producer == "acquisition-1-of-2-1"


def test_only_the_new_note_on_commands_of_the_tray_says_why_a_command_was_not_sent():
    def health(lost: int, *notes: Note) -> Health:
        counters = (Counter(name="lost_commands", value=lost),)
        return made_messages.health("acquisition", sequence=1, counters=counters, notes=notes)

    tray = TrayConfig(name="a", fans=1, source=SerialConfig(port="line"))
    commands = DeviceCommands(tray, build_source(tray.source, SourceContext(1, tray.speed_unit, Path())))

    def lose() -> str:
        commands.send(command_of(tray, {0: 0.5}), "no such port")
        return commands.notes()[0]

    first, second = lose(), lose()
    others = (
        Note(tray="a", text="the source also measures temperature"),
        Note(tray="a", text="refused input: garbage 1"),
        Note(tray="b", text=second),
    )
    before = health(1, Note(tray="a", text=first))
    assert why_not_sent("a", before, health(2, *others, Note(tray="a", text=second))) == "line: no such port"
    assert why_not_sent("a", before, health(2, *others)) == "acquisition does not say why"
    assert why_not_sent("a", before, health(1, *others, Note(tray="a", text=first))) == ""
    assert why_not_sent("a", None, health(1, Note(tray="a", text=first))) == "line: no such port"


def test_a_set_point_is_sent_in_rad_s_and_leaves_the_other_fans_alone():
    message = command_of(TrayConfig(name="a", fans=2, speed_unit="rpm", speed_max=9000), {1: 6000.0}, is_set_point=True)
    np.testing.assert_allclose(message.set_point_rad_s, [np.nan, 6000 * 2 * np.pi / 60])
    assert np.isnan(message.command).all()


@pytest.mark.parametrize(
    ("low", "high", "command", "is_noted"),
    [(0, 255, 0.6, True), (0, 100, 0.01, True), (0, 1, 0.6, False), (0, 2, 0.6, False), (0, 255, 1, False),
     (0, 255, 0, False), (-255, 255, -0.6, False)],
)  # fmt: skip
def test_a_share_is_noted_where_commands_are_no_shares(low, high, command, is_noted):
    assert bool(share_note(TrayConfig(name="a", fans=1, command_min=low, command_max=high), command)) == is_noted
