"""An HTTP server in a thread of its own."""

from __future__ import annotations

import logging
import resource
import socket
import ssl
import threading
from collections.abc import Callable
from typing import TYPE_CHECKING

from fantwin.pipeline.errors import UserError

if TYPE_CHECKING:
    from starlette.types import ASGIApp

STOP_LIMIT_S = 3.0
GRACE_S = 1
"""for answers under way when the server stops"""
_OTHER_FILES = 200
"""that the process may have open beside its connections"""


class HttpServer:
    """Answers from the start until it is stopped."""

    def __init__(
        self,
        app: ASGIApp,
        listening: socket.socket,
        tls: ssl.SSLContext | None,
        most_connections: int,
        at_end: Callable[[], None] = lambda: None,
    ) -> None:
        """Begin to answer.

        Args:
            app: answers the requests.
            listening: a socket that listens; it is closed at the end.
            tls: for https; None: http.
            most_connections: with this many connections a request is answered with 503.
            at_end: called when the server stops, so that answers that go on for ever end.
        """
        import uvicorn  # noqa: PLC0415  slow to import

        for name in ("uvicorn", "asyncio"):  # of each client that leaves without a word they say a lot
            logging.getLogger(name).setLevel(logging.CRITICAL)
        config = uvicorn.Config(
            app,
            http="h11",  # the strictest of its parsers
            ws="none",
            lifespan="off",
            log_config=None,
            access_log=False,
            server_header=False,
            proxy_headers=False,
            limit_concurrency=_within_open_files(most_connections),
            timeout_graceful_shutdown=GRACE_S,
            ssl_context_factory=None if tls is None else lambda _config, _default: tls,
        )
        self._listening, self._at_end = listening, at_end
        self._server = uvicorn.Server(config)
        self._thread = threading.Thread(
            target=self._server.run, kwargs={"sockets": [listening]}, name="http server", daemon=True
        )
        self._thread.start()

    @property
    def is_running(self) -> bool:
        """Whether it answers."""
        return self._thread.is_alive()

    def stop(self) -> None:
        """Answer what is being asked, then end."""
        self._at_end()
        self._server.should_exit = True
        self._thread.join(STOP_LIMIT_S)
        self._listening.close()


def listen(host: str, port: int, section: str) -> socket.socket:
    """Open a socket that listens. section: of the configuration, for the error.

    Raises:
        UserError: the port is taken, or the address is not of this host.
    """
    try:
        return listening_socket(host, port)
    except OSError as error:
        where = f"{section}.host = {host!r}, {section}.port = {port}"
        raise UserError(f"{where}: cannot listen there ({error.strerror}): choose another one") from error


def listening_socket(host: str, port: int) -> socket.socket:
    """Open a socket that listens. OSError: the port is taken, or the address is not of this host."""
    family, kind, protocol, _, address = socket.getaddrinfo(host.strip("[]"), port, type=socket.SOCK_STREAM)[0]
    listening = socket.socket(family, kind, protocol)  # asyncio sends without delay only where the protocol is named
    try:
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listening.bind(address)
        listening.listen(256)
    except OSError:
        listening.close()
        raise
    return listening


def _within_open_files(most_connections: int) -> int:
    """As many connections as the process may open files for, whose limit is raised as far as it is allowed to."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = most_connections + _OTHER_FILES
    if soft != resource.RLIM_INFINITY and soft < wanted:
        soft = wanted if hard == resource.RLIM_INFINITY else min(hard, wanted)
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    return most_connections if soft == resource.RLIM_INFINITY else max(1, min(most_connections, soft - _OTHER_FILES))
