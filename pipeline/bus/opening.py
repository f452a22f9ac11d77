"""Opening a session on the bus, and closing links whose other end has vanished.

Processes are peers that need no router. The first to start on a host listens on the configured endpoint; the others
connect there and discover each other. When the first dies, the rest stay connected, and the next process to start
listens on the endpoint. (Retrying to listen would take the endpoint over at once, but a session that still retries
takes at least ten seconds to close: measured with Zenoh 1.10.) A command that connects only briefly does not listen:
after it left, a new process would find no listener at the endpoint and discover the others late.

If a client is cut off while its router has data to send, the kernel of the router retransmits for a quarter of an hour.
Until then Zenoh closes neither the connection nor the session, and still shows the client's tokens. A client that
connects again meanwhile reaches nobody with its messages. Zenoh has no setting for this, so the kernel is told to give
up sooner (`given_up_soon`, `limit_connections`).

Zenoh's shared memory is off: it would copy messages of 3 kB or more into a pool, and watch the pool 20 times a second
in every process. Over a socket they cost no more, and the processes of a small site take 60 MB less.
"""

from __future__ import annotations

import json
import socket
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

import zenoh

from fantwin.pipeline.bus.endpoint import accepts_connections, foreign_program, require_tls_with_security
from fantwin.pipeline.bus.errors import BusError, reason
from fantwin.pipeline.bus.rights import SiteRoles, access_control
from fantwin.pipeline.bus.router_link import LEASE_MS, OPEN_TIMEOUT_MS, PEER_WAIT_US, RETRY
from fantwin.pipeline.bus.settings import Settings
from fantwin.pipeline.config.settings import BusConfig

if TYPE_CHECKING:
    from fantwin.pipeline.bus.credentials import Credentials


UNACKNOWLEDGED_MS = 6000
"""longest time without an acknowledgement of sent data. Longer than the lease, which ends connections with nothing to
send"""
_LOOK_S = 1.0


@contextmanager
def given_up_soon() -> Iterator[None]:
    """Inside the block, the kernel closes each TCP connection of this process that does not acknowledge sent data for
    `UNACKNOWLEDGED_MS`. A system without this setting (TCP_USER_TIMEOUT) is left as it is."""
    if not hasattr(socket, "TCP_USER_TIMEOUT"):
        yield
        return
    has_ended = threading.Event()

    def run() -> None:
        while not has_ended.wait(_LOOK_S):
            limit_connections()

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    try:
        yield
    finally:
        has_ended.set()
        thread.join()


def limit_connections() -> None:
    """Set the limit, `UNACKNOWLEDGED_MS`, for the TCP connections that this process has now."""
    try:
        paths = list(Path("/proc/self/fd").iterdir())
    except OSError:  # no descriptor is free to list them with, or there is no such folder
        return
    for path in paths:
        with suppress(OSError):  # closed meanwhile, or no socket
            if path.readlink().name.startswith("socket:"):
                its = socket.socket(fileno=int(path.name))
                try:
                    if its.type == socket.SOCK_STREAM and its.family in (socket.AF_INET, socket.AF_INET6):
                        its.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, UNACKNOWLEDGED_MS)
                finally:
                    its.detach()  # the descriptor is not ours to close


ONE_CONNECTS = {"peer": {"to_router": "always", "to_peer": "greater-zid"}}
"""Of two peers that discover each other, the one with the greater id connects. By default both connect at once, and
each may refuse the other's link as a duplicate. Over 2,000 restarts, one took a fifth of the CPU time of both."""
_ROUTER_TIMEOUT_MS = 1000
ROUTER_RETRY_S = 0.2
MEETING_LIMIT_S = 10.0
"""by then a process that listens at the endpoint has answered, however busy the machine"""


def credentials_of(config: BusConfig, roles: Sequence[str]) -> Credentials | None:
    """The checked files of the first of these roles that has a certificate here; None without `bus.security`.

    Raises:
        BusError: one cannot be used, or the endpoint does not fit.
    """
    require_tls_with_security(config)
    if config.security is None:
        return None
    from fantwin.pipeline.bus.credentials import checked_credentials  # noqa: PLC0415  takes 0.1 s, which most do without

    return checked_credentials(config.security, roles)


def answers(config: BusConfig, credentials: Credentials | None, stop: threading.Event | None) -> bool:
    """Whether a process of fantwin listens at the endpoint of a peer; False if nobody does, or `stop` is set.

    Raises:
        BusError: a program listens there and does not answer.
    """
    if not accepts_connections(config.endpoint):
        return False
    conf = _short_lived_config(config, credentials)
    until_s = time.monotonic() + MEETING_LIMIT_S
    while True:
        try:
            zenoh.open(conf).close()  # a peer would try again for ever, and takes ten seconds to close
            return True
        except zenoh.ZError as error:
            if (stop is not None and stop.is_set()) or not accepts_connections(config.endpoint):
                return False  # the listener has ended meanwhile
            if time.monotonic() > until_s:
                raise BusError(foreign_program(config.endpoint, is_secure=credentials is not None)) from error


def _short_lived_config(config: BusConfig, credentials: Credentials | None) -> zenoh.Config:
    """Of a client that only sees whether anybody answers."""
    settings = Settings()
    settings.set("mode", "client")
    settings.set("connect/endpoints", [config.endpoint])
    settings.set("connect/timeout_ms", _ROUTER_TIMEOUT_MS)
    settings.set("scouting/multicast/enabled", False)
    settings.secure(credentials)
    return settings.config


def open_session(
    config: BusConfig,
    credentials: Credentials | None,
    stop: threading.Event | None,
    listens: bool,
    site: SiteRoles | None,
    session_id: str,
) -> zenoh.Session:
    """A session: of a peer at once; of a client as soon as its router answers.

    Raises:
        BusError: the endpoint cannot be used, or no router answers, and `stop` is set or None.
    """
    try:
        conf = zenoh_config(config, credentials, site, listens=listens, session_id=session_id)
        if config.mode == "peer":
            return zenoh.open(conf)
    except zenoh.ZError as error:
        raise BusError(f"bus.endpoint = {config.endpoint!r} cannot be used: {reason(error)}") from error
    until_s = time.monotonic() + (MEETING_LIMIT_S if stop else 0.0)
    attempts = 0
    while True:  # Zenoh can wait for the router itself, but then ignores Ctrl-C
        first = attempts % len(config.endpoints)
        endpoints = (*config.endpoints[first:], *config.endpoints[:first])  # it never gets to one after one that hangs
        try:
            conf.insert_json5("connect/endpoints", json.dumps(endpoints))
            return zenoh.open(conf)
        except zenoh.ZError as error:
            attempts += 1
            if attempts < len(endpoints):
                continue
            if stop is None and attempts == len(endpoints) and accepts_connections(config.endpoint):
                time.sleep(ROUTER_RETRY_S)  # a router that is just starting accepts connections before it answers
                continue
            if time.monotonic() > until_s and accepts_connections(config.endpoint):
                raise BusError(foreign_program(config.endpoint, is_secure=credentials is not None)) from error
            if stop is None or stop.wait(ROUTER_RETRY_S):
                raise BusError(
                    f"bus.endpoint = {config.endpoint!r}: no router answers: {reason(error)}; start `fantwin router`"
                ) from error


def zenoh_config(
    config: BusConfig,
    credentials: Credentials | None = None,
    site: SiteRoles | None = None,
    *,
    listens: bool,
    session_id: str = "",
) -> zenoh.Config:
    """What Zenoh is configured with for a session that stays. Without `session_id` Zenoh chooses one."""
    settings = Settings()
    if session_id:
        settings.set("id", session_id)
    settings.set("mode", config.mode)
    settings.set("connect/endpoints", list(config.endpoints))
    settings.set("connect/timeout_ms", -1 if config.mode == "peer" else _ROUTER_TIMEOUT_MS)
    settings.set("connect/exit_on_failure", False)
    settings.set("connect/retry", RETRY)
    if config.mode == "client":
        settings.set("transport/link/tx/lease", int(LEASE_MS))
        settings.set("transport/unicast/open_timeout", OPEN_TIMEOUT_MS)
    settings.set("scouting/multicast/enabled", False)
    settings.set("transport/shared_memory/enabled", False)
    if config.mode == "peer":
        host = config.endpoint.rsplit(":", 1)[0]
        settings.set("listen/endpoints", [*([config.endpoint] if listens else []), f"{host}:0"])
        settings.set("listen/timeout_ms", 0)
        settings.set("listen/exit_on_failure", False)
        settings.set("scouting/gossip/enabled", True)
        settings.set("scouting/gossip/autoconnect_strategy", ONE_CONNECTS)
        settings.set("transport/link/tx/queue/congestion_control/block/wait_before_close", PEER_WAIT_US)
        if credentials and site:
            settings.set("access_control", access_control(site))
    settings.secure(credentials)
    settings.pass_through(config.zenoh)
    return settings.config
