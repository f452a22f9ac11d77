"""An endpoint at which nobody would ever meet is one line."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator
from contextlib import closing

import pytest

from fantwin.pipeline.bus.endpoint import accepts_connections, endpoint_problem, somebody_listens
from fantwin.pipeline.bus.errors import BusError
from fantwin.pipeline.bus.router import open_router
from fantwin.pipeline.bus.session import Bus, join_bus
from fantwin.pipeline.config.settings import BusConfig
from tests.support.secured_site import SecuredSite, free_endpoint
from tests.support.tcp_relay import TcpRelay


@pytest.fixture
def foreign() -> Iterator[str]:
    """The endpoint of a program that accepts connections and never answers."""
    with socket.create_server(("127.0.0.1", 0)) as listening:
        yield f"tcp/127.0.0.1:{listening.getsockname()[1]}"


@pytest.mark.parametrize("host", ["no-such-host.invalid", f"{'x' * 70}.invalid"])
def test_row_15_a_host_that_cannot_be_found_is_one_line(host):
    with pytest.raises(BusError, match=f"^bus.endpoint = 'tcp/{host}:7447': the host '{host}' cannot be found"):
        Bus(BusConfig(endpoint=f"tcp/{host}:7447"))


@pytest.mark.parametrize("endpoint", ["tcp/127.0.0.1:7447", "tcp/[::1]:7447", "udp/localhost:1", "unixsock-stream/x"])
def test_row_15_other_endpoints_are_left_to_zenoh(endpoint):
    assert endpoint_problem(endpoint) == ""


@pytest.mark.parametrize(("mode", "stop"), [("peer", None), ("client", threading.Event())])
def test_row_15_a_foreign_program_at_the_endpoint_is_one_line(foreign, monkeypatch, mode, stop):
    monkeypatch.setattr("fantwin.pipeline.bus.opening.MEETING_LIMIT_S", 0.0)
    with pytest.raises(BusError) as refused:
        Bus(BusConfig(mode=mode, endpoint=foreign), stop)
    assert str(refused.value) == (
        f"bus.endpoint = {foreign!r}: the program that listens there is not fantwin, or hangs, so stages cannot "
        "connect: stop it, or choose another port"
    )


def test_row_15_tls_on_one_side_only_is_one_line_that_says_so(tmp_path, monkeypatch, foreign):
    monkeypatch.setattr("fantwin.pipeline.bus.opening.MEETING_LIMIT_S", 0.0)
    with SecuredSite(tmp_path, free_endpoint()).running() as site:
        for mode in ("peer", "client"):
            config = BusConfig.model_validate({"mode": mode, "endpoint": site.endpoint.replace("tls/", "tcp/")})
            with pytest.raises(BusError, match="the program that listens there takes TLS only: give this config"):
                Bus(config)
    site = SecuredSite(tmp_path, foreign, is_new=False)
    with pytest.raises(BusError, match="the program that listens there takes no TLS: it has no"):
        join_bus(site.config, roles=("viewer",))


def test_row_15_a_command_tries_again_where_a_router_is_just_starting(endpoint, monkeypatch):
    """It accepts connections and does not answer yet."""
    with open_router(endpoint), closing(TcpRelay(endpoint)) as relay:
        relay.cut()

        def is_asked(asked: str) -> bool:
            relay.heal()
            return accepts_connections(asked)

        monkeypatch.setattr("fantwin.pipeline.bus.opening.accepts_connections", is_asked)
        with Bus(BusConfig(mode="client", endpoint=relay.endpoint)) as bus:
            assert bus.alive("fantwin/**") == set()


def test_row_15_where_nobody_listens_nobody_is_waited_for_and_a_process_that_answers_is_no_foreign_program(endpoint):
    assert not somebody_listens(endpoint)
    assert not accepts_connections(endpoint)
    with Bus(BusConfig(endpoint=endpoint)), Bus(BusConfig(endpoint=endpoint)) as second:
        assert somebody_listens(endpoint)
        assert accepts_connections(endpoint)
        second.wait_for_others(threading.Event())
