"""TCP connections whose other end has vanished are given up soon.

A router that has something to send to a client that was cut off waits for the kernel, which repeats it for a quarter of
an hour. Until then Zenoh closes neither the connection nor the session, and shows the client's tokens; the client comes
back by another connection, and nothing that it sends arrives anywhere. Zenoh has no setting for it.
"""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

UNACKNOWLEDGED_MS = 6000
"""so long something that was sent may stay without an acknowledgement: longer than the lease, which alone ends a
connection with nothing to send"""
_LOOK_S = 1.0


@contextmanager
def given_up_soon() -> Iterator[None]:
    """Until the block ends, all TCP connections of this process are given up when what was sent is not acknowledged in
    time. Where the system has no such setting, nothing happens."""
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
    """Set the limit for the TCP connections that this process has now."""
    for path in Path("/proc/self/fd").iterdir():
        with suppress(OSError):  # closed meanwhile, or no socket
            if path.readlink().name.startswith("socket:"):
                its = socket.socket(fileno=int(path.name))
                try:
                    if its.type == socket.SOCK_STREAM and its.family in (socket.AF_INET, socket.AF_INET6):
                        its.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, UNACKNOWLEDGED_MS)
                finally:
                    its.detach()  # it stays open
