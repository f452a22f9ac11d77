"""The HTTP server, in a thread of its own."""

from __future__ import annotations

import logging
import socket
import ssl
import threading
from collections.abc import Callable
from pathlib import Path

import uvicorn
from starlette.types import ASGIApp

from pipeline.runtime.stage import StageError

STOP_LIMIT_S = 3.0
MOST_CONNECTIONS = 2000


class WebServer:
    """Listens from the start; answers until it is stopped."""

    def __init__(
        self, app: ASGIApp, listening: socket.socket, tls: tuple[Path, Path] | None, end: Callable[[], None]
    ) -> None:
        """tls: certificate and key, for https. end: sends those away who receive live events."""
        self._end = end
        self._listening = listening
        config = uvicorn.Config(
            app,
            lifespan="off",
            log_config=None,
            access_log=False,
            server_header=False,
            proxy_headers=False,
            limit_concurrency=MOST_CONNECTIONS,
            timeout_graceful_shutdown=1,
            ssl_certfile=tls[0] if tls else None,
            ssl_keyfile=tls[1] if tls else None,
        )
        logging.getLogger("uvicorn").setLevel(logging.CRITICAL)
        self._server = uvicorn.Server(config)
        self._server.install_signal_handlers = lambda: None  # type: ignore[attr-defined]  of the main thread only
        self._thread = threading.Thread(target=self._server.run, args=([listening],), name="web server", daemon=True)
        self._thread.start()

    @property
    def problem(self) -> str:
        """Empty while it answers."""
        return "" if self._thread.is_alive() else "the web server has ended: restart the gateway"

    def stop(self) -> None:
        """Answer what is being asked, then end."""
        self._end()
        self._server.should_exit = True
        self._thread.join(STOP_LIMIT_S)
        self._listening.close()


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
    try:
        ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(certificate, key)
    except OSError as error:
        raise StageError(f"gateway.certificate = {str(certificate)!r}, gateway.key = {str(key)!r}: {error}") from error
