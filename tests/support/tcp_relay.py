"""A link between a client and its router that can be cut: it passes bytes of TCP connections on, or not."""

from __future__ import annotations

import selectors
import socket
import threading
from contextlib import suppress

_READ_BYTES = 1 << 16
_POLL_S = 0.02


class TcpRelay:
    """Relays in a thread of its own, from the beginning to `close`.

    While it is cut, nothing is passed on, and no connection is closed, as where packets are dropped: both ends find out
    by themselves. What they had sent is delivered afterwards, if they have not given the connection up by then.
    """

    def __init__(self, endpoint: str) -> None:
        """endpoint: of the router, `tcp/host:port`."""
        host, _, port = endpoint.removeprefix("tcp/").rpartition(":")
        self._router = (host, int(port))
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.endpoint = f"tcp/127.0.0.1:{self._listener.getsockname()[1]}"
        """where the clients connect to"""
        self._is_cut = threading.Event()
        self._has_ended = threading.Event()
        self._partners: dict[socket.socket, socket.socket] = {}
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def cut(self) -> None:
        """Pass nothing on."""
        self._is_cut.set()

    def heal(self) -> None:
        """Pass everything on again."""
        self._is_cut.clear()

    def close(self) -> None:
        """End all connections."""
        self._has_ended.set()
        self._thread.join()
        for each in (self._listener, *self._partners):
            each.close()

    def _run(self) -> None:
        while not self._has_ended.is_set():
            if self._is_cut.is_set():
                self._has_ended.wait(_POLL_S)
                continue
            with selectors.DefaultSelector() as selector:
                for each in (self._listener, *self._partners):
                    selector.register(each, selectors.EVENT_READ)
                ready = [key.fileobj for key, _ in selector.select(_POLL_S)]
            for each in ready:
                if each is self._listener:
                    self._connect()
                elif isinstance(each, socket.socket) and each in self._partners:
                    self._pass_on(each)

    def _connect(self) -> None:
        client, _ = self._listener.accept()
        try:
            router = socket.create_connection(self._router)
        except OSError:  # it is not there
            client.close()
            return
        self._partners |= {client: router, router: client}

    def _pass_on(self, source: socket.socket) -> None:
        data = b""
        with suppress(OSError):
            data = source.recv(_READ_BYTES)
            if data:
                self._partners[source].sendall(data)
                return
        for each in (source, self._partners.pop(source)):
            self._partners.pop(each, None)
            each.close()
