"""The HTTP server, in a thread of its own."""

from __future__ import annotations

import asyncio
import logging
import resource
import socket
import ssl
import threading
from collections import Counter
from collections.abc import Callable, Set
from contextlib import suppress
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

import uvicorn
from cryptography import x509
from cryptography.hazmat.primitives.serialization import load_pem_private_key
from starlette.types import ASGIApp
from uvicorn.protocols.http.h11_impl import H11Protocol

from fantwin.pipeline.runtime.stage import StageError
from fantwin.pipeline.site.login_failures import network_of

STOP_LIMIT_S = 3.0
MOST_CONNECTIONS = 2000
MOST_OF_AN_ADDRESS = 100
"""connections from elsewhere; on this host, and from a proxy, are many people"""
REQUEST_WITHIN_S = 10.0
"""whoever has connected, or begun another request, sends its head within this time"""
_EVERYBODY = 0o007
_OTHER_FILES = 200
"""that the process may have open beside its connections"""


class WebServer:
    """Listens from the start; answers until it is stopped."""

    def __init__(
        self,
        app: ASGIApp,
        listening: socket.socket,
        tls: tuple[Path, Path] | None,
        end: Callable[[], None],
        unlimited: Set[str] = frozenset(),
    ) -> None:
        """tls: certificate and key, for https. end: sends those away who receive live events. unlimited: addresses from
        which many people come."""
        self._end = end
        self._listening = listening
        self._expires = expiry_of(tls[0]) if tls else None
        config = uvicorn.Config(
            app,
            http=partial(_Connection, Connections(unlimited, most_connections())),  # type: ignore[arg-type]  it is called as the class
            lifespan="off",
            log_config=None,
            access_log=False,
            server_header=False,
            proxy_headers=False,
            timeout_graceful_shutdown=1,
            ssl_certfile=tls[0] if tls else None,
            ssl_keyfile=tls[1] if tls else None,
        )
        for name in ("uvicorn", "asyncio"):  # of each client that leaves without a word they say a lot
            logging.getLogger(name).setLevel(logging.CRITICAL)
        self._server = uvicorn.Server(config)
        self._thread = threading.Thread(target=self._run, name="web server", daemon=True)
        self._thread.start()

    @property
    def problem(self) -> str:
        """Empty while it answers."""
        if not self._thread.is_alive():
            return "the web server has ended: restart the gateway"
        if self._expires is not None and self._expires < datetime.now(UTC):
            return f"the certificate is over since {self._expires:%Y-%m-%d}: replace it, and restart the gateway"
        return ""

    def stop(self) -> None:
        """Answer what is being asked, then end."""
        self._end()
        self._server.should_exit = True
        self._thread.join(STOP_LIMIT_S)
        self._listening.close()

    def _run(self) -> None:
        with asyncio.Runner(loop_factory=_Loop) as runner:
            runner.run(self._server.serve([self._listening]))


class _Loop(asyncio.SelectorEventLoop):
    """Whoever connects by TLS agrees on it in time, too."""

    async def create_server(self, *args: Any, **settings: Any) -> asyncio.Server:
        within_s = REQUEST_WITHIN_S if settings.get("ssl") else None
        return await super().create_server(*args, **settings, ssl_handshake_timeout=within_s)


class Connections:
    """How many there are, and from each address."""

    def __init__(self, unlimited: Set[str], most: int) -> None:
        """unlimited: addresses that may have all of them."""
        self._unlimited, self._most = unlimited, most
        self._open: Counter[str] = Counter()

    def begin(self, address: str) -> bool:
        """One more; returns whether there are too many."""
        network = network_of(address)
        self._open[network] += 1
        is_limited = address not in self._unlimited
        return self._open.total() > self._most or (is_limited and self._open[network] > MOST_OF_AN_ADDRESS)

    def end(self, address: str) -> None:
        """One less."""
        self._open[network_of(address)] -= 1
        self._open += Counter()  # without those that have none


class _Connection(H11Protocol):
    """One connection. Whoever connects and sends nothing, or little by little, is sent away."""

    def __init__(self, connections: Connections, *args: Any, **settings: Any) -> None:
        super().__init__(*args, **settings)
        self._connections = connections
        self._address: str | None = None
        self._request_timer: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self._address = self.client[0] if self.client else ""
        if self._connections.begin(self._address):
            transport.abort()
            return
        self._watch()

    def connection_lost(self, exc: Exception | None) -> None:
        super().connection_lost(exc)
        if self._address is not None:
            self._connections.end(self._address)
            self._address = None
        self._forget_timer()

    def data_received(self, data: bytes) -> None:
        super().data_received(data)
        self._watch()

    def _watch(self) -> None:
        """Wait for the head of a request, unless one is being answered."""
        if self.cycle is not None and not self.cycle.response_complete:
            self._forget_timer()
        elif self._request_timer is None:
            self._request_timer = self.loop.call_later(REQUEST_WITHIN_S, self.transport.abort)

    def _forget_timer(self) -> None:
        if self._request_timer is not None:
            self._request_timer.cancel()
            self._request_timer = None


def most_connections() -> int:
    """How many there may be: as many files as the process may open, which is raised as far as it is allowed to."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = MOST_CONNECTIONS + _OTHER_FILES
    if soft != resource.RLIM_INFINITY and soft < wanted:
        soft = wanted if hard == resource.RLIM_INFINITY else min(hard, wanted)
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    return MOST_CONNECTIONS if soft == resource.RLIM_INFINITY else max(1, min(MOST_CONNECTIONS, soft - _OTHER_FILES))


def listen(host: str, port: int) -> socket.socket:
    """A socket that listens.

    Raises:
        StageError: the port is taken, or the address is not of this host.
    """
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host.strip("[]"), port, type=socket.SOCK_STREAM)[0]
        listening = socket.socket(family, kind, protocol)
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listening.bind(address)
        listening.listen(256)
    except OSError as error:
        where = f"gateway.host = {host!r}, gateway.port = {port}"
        raise StageError(f"{where}: cannot listen there ({error.strerror}): choose another one") from error
    return listening


def check_certificate(certificate: Path, key: Path) -> None:
    """Raises:
    StageError: these are no certificate and its key.
    """
    of_certificate, of_key = f"gateway.certificate = {str(certificate)!r}", f"gateway.key = {str(key)!r}"
    try:
        public = x509.load_pem_x509_certificate(certificate.read_bytes()).public_key()
    except (OSError, ValueError) as error:
        raise StageError(f"{of_certificate}: {_why(error, 'this is no certificate in PEM')}") from error
    try:
        private = load_pem_private_key(key.read_bytes(), None)
    except TypeError as error:
        raise StageError(
            f"{of_key}: the key has a password, which nobody is asked for: `openssl pkey -in KEY -out NEW` takes it out"
        ) from error
    except (OSError, ValueError) as error:
        raise StageError(f"{of_key}: {_why(error, 'this is no private key in PEM')}") from error
    if private.public_key() != public:
        raise StageError(f"{of_key}: this is not the key of the certificate {str(certificate)!r}")
    try:  # without a password, nobody is asked for it on the terminal
        ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(certificate, key, password=lambda: "")
    except OSError as error:
        raise StageError(f"{of_certificate}, {of_key}: {error.strerror or error}") from error


def _why(error: OSError | ValueError, otherwise: str) -> str:
    return (error.strerror or str(error)) if isinstance(error, OSError) else otherwise


def check_files(certificate: Path, key: Path) -> None:
    """Raises:
    StageError: the certificate is over, or everybody may read its key.
    """
    expires = expiry_of(certificate)
    if expires is not None and expires < datetime.now(UTC):
        raise StageError(f"gateway.certificate = {str(certificate)!r}: it is over since {expires:%Y-%m-%d}")
    with suppress(OSError):  # that it cannot be read is said elsewhere
        if key.stat().st_mode & _EVERYBODY:
            raise StageError(f"gateway.key = {str(key)!r}: everybody may read it: chmod o= {key}")


def expiry_of(certificate: Path) -> datetime | None:
    """When it is over; None: it cannot be read."""
    try:
        return x509.load_pem_x509_certificate(certificate.read_bytes()).not_valid_after_utc
    except (OSError, ValueError):
        return None
