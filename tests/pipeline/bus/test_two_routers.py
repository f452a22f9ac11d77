"""Two routers of a site: clients of either hear one another, and go to the other one when theirs has gone."""

from __future__ import annotations

import queue
import socket
import threading
from collections.abc import Iterator

import pytest
from pydantic import ValidationError

from pipeline.bus.session import Bus
from pipeline.config.models import BusConfig
from schemas.topics import BY_NAME, alive_key, tray_key
from tests.support.running_chain import RunningCommand, eventually

KEY = tray_key("site", "tray", "alarm")
TOKEN = alive_key("site", "scorer", "all")


class Routers:
    """Two, at endpoints of their own."""

    def __init__(self) -> None:
        with socket.socket() as one, socket.socket() as other:
            for probe in (one, other):
                probe.bind(("127.0.0.1", 0))
            self.endpoints = [f"tcp/127.0.0.1:{probe.getsockname()[1]}" for probe in (one, other)]
        self.running: dict[int, RunningCommand] = {}

    def start(self, number: int) -> None:
        listen, connect = self.endpoints[number], self.endpoints[1 - number]
        self.running[number] = RunningCommand(["router", "--listen", listen, "--connect", connect])

    def kill(self, number: int) -> None:
        self.running[number].kill()

    def client(self, *numbers: int) -> Bus:
        endpoints = [self.endpoints[number] for number in numbers]
        return Bus(BusConfig.model_validate({"mode": "client", "endpoint": endpoints}), threading.Event())


@pytest.fixture
def routers() -> Iterator[Routers]:
    found = Routers()
    yield found
    for router in found.running.values():
        router.kill()


@pytest.mark.real_time
def test_row_16_clients_of_two_routers_hear_one_another_whichever_of_them_is_there(routers):
    """Each router is killed and started again, one after the other: a client that has both never stays apart."""
    routers.start(0)
    routers.start(1)
    heard: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    with routers.client(0, 1) as listener, routers.client(1, 0) as speaker:
        tokens: dict[str, bool] = {}
        listener.subscribe(KEY, lambda _key, payload: heard.put(payload))
        listener.watch_alive(TOKEN, tokens.__setitem__)
        speaker.declare_alive(TOKEN)
        publisher = speaker.publisher(KEY, BY_NAME["alarm"], "x", "speaker")

        def are_together(about: bytes) -> None:
            def is_heard() -> bool:
                publisher.put(about)
                while not heard.empty():
                    if heard.get() == about:
                        return True
                return False

            eventually(is_heard, f"it is heard {about.decode()}")
            eventually(lambda: tokens.get(TOKEN), f"the token is seen {about.decode()}")

        are_together(b"by two routers")
        for number in (0, 1):
            routers.kill(number)
            are_together(b"without router %d" % number)
            routers.start(number)
            are_together(b"with router %d again" % number)


def test_peers_have_one_endpoint():
    with pytest.raises(ValidationError, match="peers meet at one endpoint"):
        BusConfig.model_validate({"endpoint": ["tcp/127.0.0.1:1", "tcp/127.0.0.1:2"]})
