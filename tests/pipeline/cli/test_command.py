"""`fantwin command`: what is wanted of a fan reaches its line, or one line says why not."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from pathlib import Path

import numpy as np
import pytest
from typer.testing import Result

from fantwin.pipeline.acquisition.device_commands import DeviceCommands
from fantwin.pipeline.bus.publisher import Publisher
from fantwin.pipeline.bus.session import Bus
from fantwin.pipeline.cli.watch import commanding
from fantwin.pipeline.cli.watch.commanding import CommandSender, command_of, share_note, why_not_sent
from fantwin.pipeline.config.models import BusConfig, TrayConfig
from fantwin.pipeline.runtime.sessions import Session
from fantwin.pipeline.sources.kinds import build_source
from fantwin.pipeline.sources.serial.config import SerialConfig
from fantwin.pipeline.sources.source import SourceContext
from fantwin.schemas.codec import encode, type_name
from fantwin.schemas.health import Counter, Health, Note
from fantwin.schemas.topics import BY_NAME, alive_key, health_key
from tests.support import made_messages
from tests.support.fantwin_command import error_of, fantwin
from tests.support.running_chain import DEADLINE_S, Chain, RunningCommand, eventually


@pytest.fixture
def chain(tmp_path: Path, endpoint: str) -> Iterator[Chain]:
    chain = Chain(tmp_path, endpoint)
    yield chain
    chain.close()


def test_what_the_line_did_not_take_is_one_line_that_says_why_and_a_note_names_what_was_probably_meant(
    chain, monkeypatch
):
    monkeypatch.setattr(commanding, "_ANSWER_S", DEADLINE_S)  # a command waits for the acquisition, which starts
    acquisition = RunningCommand(["up", "--only", "acquisition", *chain.words("run")[1:]])
    try:
        error = error_of(*chain.words("command"), "--fan", 3, 0.5)  # there is no tray
        assert "tray tray1: the command failed: " in error and str(chain.port) in error
        chain.start_tray()
        words = (*chain.words("command"), "--set", "tray.0.command_max=255", "--json")

        def sent() -> Result | None:
            done = fantwin(*words, "--fan", 3, 0.6)
            return None if done.exit_code else done

        done = eventually(sent, "the acquisition takes a command")
    finally:
        acquisition.kill()
    assert json.loads(done.stdout)["value"] == 0.6
    assert done.stderr == "note: commands of tray tray1 go from 0 to 255, and 0.6 was sent; 60 % of this range is 153\n"


def test_without_an_acquisition_the_command_is_reported_as_not_received(chain, monkeypatch):
    monkeypatch.setattr(commanding, "_ANSWER_S", 0.1)
    expected = "no acquisition of tray tray1 received the command: is `fantwin up` running?"
    assert error_of(*chain.words("command"), "--fan", 3, 0.5) == expected


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
