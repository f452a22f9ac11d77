"""Ports on loopback for the servers of tests."""

from __future__ import annotations

import socket

MOST_HELD = 100
_held: list[socket.socket] = []


def free_port() -> int:
    """A port that nobody else is given before it is used.

    A socket stays bound to it and does not listen: a connection is refused, and a server, which sets SO_REUSEADDR, can
    listen there.
    """
    if len(_held) == MOST_HELD:
        _held.pop(0).close()
    holder = socket.socket()
    holder.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    holder.bind(("127.0.0.1", 0))
    _held.append(holder)
    return holder.getsockname()[1]
