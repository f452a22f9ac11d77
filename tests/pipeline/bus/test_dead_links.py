"""The limit of the system after which a router closes a connection that acknowledges no data."""

from __future__ import annotations

import socket
import threading
from contextlib import closing, suppress
from pathlib import Path

import pytest

from fantwin.pipeline.bus.opening import UNACKNOWLEDGED_MS, limit_connections, zenoh_config
from fantwin.pipeline.bus.router import open_router
from fantwin.pipeline.bus.router_link import LEASE_MS
from fantwin.pipeline.bus.session import Bus
from fantwin.pipeline.config.settings import BusConfig
from tests.support.running_chain import eventually

pytestmark = pytest.mark.skipif(not hasattr(socket, "TCP_USER_TIMEOUT"), reason="this system has no such limit")

BOTH_MODES = BusConfig(mode="client"), BusConfig(mode="peer")


def limits_ms(port: int) -> list[int]:
    """The limits of the connections that this process has accepted at a port, ms."""
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


def test_row_16_each_connection_to_a_router_has_the_limit_for_data_without_acknowledgement(endpoint):
    port = int(endpoint.rpartition(":")[2])
    with open_router(endpoint), Bus(BusConfig(mode="client", endpoint=endpoint), threading.Event()):
        eventually(lambda: limits_ms(port) == [UNACKNOWLEDGED_MS], "it has the limit")
    assert int(LEASE_MS) < UNACKNOWLEDGED_MS, "a cut that is shorter than the lease ends no connection"


def test_row_16_a_client_and_its_router_notice_a_dead_connection_after_four_seconds():
    """Peers after the ten seconds of Zenoh."""
    leases = [zenoh_config(config, listens=False).get_json("transport/link/tx/lease") for config in BOTH_MODES]
    assert leases == [LEASE_MS, "10000"] and LEASE_MS == "4000"


def test_other_sockets_stay_as_they_are():
    ours, theirs = socket.socketpair()
    with closing(ours), closing(theirs):
        limit_connections()
        ours.send(b"still there")
        assert theirs.recv(99) == b"still there"
