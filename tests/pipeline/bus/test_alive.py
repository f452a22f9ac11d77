"""`Bus.alive`: a missing answer does not mean that no session is there."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import closing

import pytest

from fantwin.pipeline.bus.errors import BusError
from fantwin.pipeline.bus.router import open_router
from fantwin.pipeline.bus.session import Bus
from fantwin.pipeline.config.settings import BusConfig
from tests.support.running_chain import eventually
from tests.support.tcp_relay import TcpRelay

KEY, ALL = "fantwin/s/alive/scorer/all", "fantwin/s/alive/*/*"
TIMEOUT_S = 0.4


@pytest.fixture
def link(endpoint: str, monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[TcpRelay, Bus]]:
    """A client behind a link that can be cut, at a router where a scorer is."""
    monkeypatch.setattr(Bus, "answer_timeout_s", TIMEOUT_S)

    def client(at: str) -> Bus:
        return Bus(BusConfig(mode="client", endpoint=at), threading.Event())

    with open_router(endpoint), closing(TcpRelay(endpoint)) as relay, client(endpoint) as scorer:
        scorer.declare_alive(KEY)
        with client(relay.endpoint) as asks:
            eventually(lambda: _answer(asks) == {KEY}, "they have met")
            yield relay, asks


def test_row_18_whoever_cannot_ask_does_not_say_that_nobody_is_there(link):
    relay, asks = link
    relay.cut()
    with pytest.raises(BusError, match=r"no complete answer within 0\.8 s .*: check that the router runs"):
        asks.alive(ALL)
    relay.heal()
    eventually(lambda: _answer(asks) == {KEY}, "the router answers again")


def test_row_18_a_question_is_repeated_if_the_answer_did_not_come_in_time(link, monkeypatch):
    relay, asks = link
    monkeypatch.setattr("fantwin.pipeline.bus.session._ALIVE_TIMEOUTS", 1000)
    monkeypatch.setattr(asks._stop, "wait", lambda _timeout_s: relay.heal())  # between two questions
    relay.cut()
    assert asks.alive(ALL) == {KEY}


def test_row_18_a_client_that_has_lost_its_router_knows_nobody(link):
    relay, asks = link
    relay.close()
    with pytest.raises(BusError, match="no complete answer"):
        eventually(lambda: asks.alive(ALL) == set(), "its tokens have gone")


def _answer(bus: Bus) -> set[str]:
    try:
        return bus.alive(ALL)
    except BusError:
        return set()
