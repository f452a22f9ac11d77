"""A router gives a connection up whose other end has vanished, also if it has something to send there."""

from __future__ import annotations

import socket
import threading
from contextlib import closing, suppress
from pathlib import Path

import pytest

from pipeline.bus.dead_links import UNACKNOWLEDGED_MS, limit_connections
from pipeline.bus.link import LEASE_MS
from pipeline.bus.router import open_router
from pipeline.bus.session import Bus
from pipeline.config.models import BusConfig
from tests.support.running_chain import eventually

pytestmark = pytest.mark.skipif(not hasattr(socket, "TCP_USER_TIMEOUT"), reason="this system has no such limit")


def limits_ms(port: int) -> list[int]:
    """Of the connections of this process to which others have connected at a port."""
    found: list[int] = []
    for path in Path("/proc/self/fd").iterdir():
        with suppress(OSError, TypeError, IndexError):
            its = socket.socket(fileno=int(path.name))
            try:
                its.getpeername()
                if its.getsockname()[1] == port:
                    found.append(its.getsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT))
            finally:
                its.detach()
    return found


def test_row_16_a_router_gives_up_each_connection_that_acknowledges_nothing(endpoint):
    port = int(endpoint.rpartition(":")[2])
    with open_router(endpoint), Bus(BusConfig(mode="client", endpoint=endpoint), threading.Event()):
        eventually(lambda: limits_ms(port) == [UNACKNOWLEDGED_MS], "it has the limit")
    assert int(LEASE_MS) < UNACKNOWLEDGED_MS, "a cut that is shorter than the lease ends no connection"


def test_other_sockets_stay_as_they_are():
    ours, theirs = socket.socketpair()
    with closing(ours), closing(theirs):
        limit_connections()
        ours.send(b"still there")
        assert theirs.recv(99) == b"still there"
