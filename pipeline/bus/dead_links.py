"""Closes TCP connections whose other end has vanished.

If a client is cut off while its router has data to send, the kernel of the router retransmits for a quarter of an hour.
Until then Zenoh closes neither the connection nor the session, and still shows the client's tokens. A client that
connects again meanwhile reaches nobody with its messages. Zenoh has no setting for this.
"""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

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
