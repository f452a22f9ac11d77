"""Two routers of a site: clients of either hear one another, and go to the other one when theirs has gone."""

from __future__ import annotations

import queue
import threading
from collections.abc import Iterator
from dataclasses import replace

import pytest

from fantwin.pipeline.bus.errors import BusError
from fantwin.pipeline.bus.rights import SiteRoles
from fantwin.pipeline.bus.router import open_router
from fantwin.pipeline.bus.session import Bus, join_bus
from fantwin.pipeline.config.settings import BusConfig
from fantwin.schemas.topics import BY_NAME, alive_key, tray_key
from tests.support.ports import free_port
from tests.support.running_chain import RunningCommand, eventually
from tests.support.secured_site import SITE, SecuredSite, free_endpoint, put

KEY = tray_key("site", "tray", "alarm")
TOKEN = alive_key("site", "scorer", "all")


class Routers:
    """Two, at endpoints of their own."""

    def __init__(self) -> None:
        self.endpoints = [f"tcp/127.0.0.1:{free_port()}" for _ in range(2)]
        self.running: dict[int, RunningCommand] = {}

    def start(self, number: int) -> None:
        listen, connect = self.endpoints[number], self.endpoints[1 - number]
        self.running[number] = RunningCommand(["router", "--listen", listen, "--connect", connect])

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
            routers.running[number].kill()
            are_together(b"without router %d" % number)
            routers.start(number)
            are_together(b"with router %d again" % number)


@pytest.fixture
def secured(tmp_path) -> Iterator[tuple[SecuredSite, SecuredSite]]:
    """A site by each of its two routers, which are connected. The second one does not let the recorder read."""
    first = SecuredSite(tmp_path, free_endpoint())
    second = SecuredSite(tmp_path, free_endpoint(), is_new=False)
    roles = dict(first.site.roles)
    fewer = SiteRoles(SITE, {**roles, "recorder": replace(roles["recorder"], reads=())})
    with (
        first.running(),
        second.sessions_of(),
        open_router(second.endpoint, second.credentials("router"), fewer, others=[first.endpoint]),
    ):
        yield first, second


def test_clients_of_two_secured_routers_may_do_on_either_what_their_role_may(secured):
    """Samples, what was missed, and tokens pass from one router to the other; what a role may not do passes neither."""
    first, second = secured
    key, alive = tray_key(SITE, "a", "raw"), alive_key(SITE, "acquisition", "all")
    tokens: dict[str, bool] = {}
    with (
        join_bus(first.config, roles=("resampler",)) as reader,
        join_bus(second.config, roles=("acquisition",)) as writer,
        join_bus(second.config, roles=("resampler",)) as reader_there,
    ):
        received: dict[Bus, list[bytes]] = {reader: [], reader_there: []}
        for bus, heard in received.items():
            bus.subscribe(key, lambda _key, payload, heard=heard: heard.append(payload))
        reader.watch_alive(alive, tokens.__setitem__)
        writer.declare_alive(alive)
        publisher = writer.publisher(key, BY_NAME["raw"], "x", "me")
        for bus in (reader, reader_there, writer):
            bus.require_rights()
        eventually(lambda: tokens.get(alive), "the token passes")
        eventually(lambda: publisher.put(b"sample") or all(received.values()), "samples pass to both")
        recovered = eventually(lambda: reader.recover(key, "me"), "they can be recovered")
        assert {payload for _, payload in recovered} == {b"sample"}
        for site in secured:
            for role in ("viewer", "acquisition.b"):
                liveliness = site.session(role).liveliness().declare_token(alive_key(SITE, "scorer", "all"))
                put(site.session(role), key, b"forged")
                site.flush(role)
                for bus in (reader, reader_there):
                    assert bus.alive(alive_key(SITE, "*", "*")) <= {alive}, "the forged token is nowhere"
                liveliness.undeclare()
        eventually(lambda: reader.alive(alive_key(SITE, "*", "*")) == {alive}, "the token is seen behind both routers")
        publisher.put(b"last")
        eventually(lambda: all(heard[-1] == b"last" for heard in received.values()), "the last one has arrived")
    assert all(set(heard) == {b"sample", b"last"} for heard in received.values())


def test_a_client_asks_its_own_router_for_its_rights_and_no_other(secured):
    """The other one answers as well, and may have other rules."""
    first, second = secured
    with join_bus(first.config, roles=("recorder",)) as good, join_bus(second.config, roles=("recorder",)) as refused:
        for bus in (good, refused):
            bus.subscribe(tray_key(SITE, "a", "raw"), lambda _key, _payload: None)
        for _ in range(3):
            good.require_rights()
            with pytest.raises(BusError, match="the router does not let 'recorder' read raw of a"):
                refused.require_rights()
        assert good.has_all_rights_of_its_role(first.site)
        assert not refused.has_all_rights_of_its_role(first.site)
