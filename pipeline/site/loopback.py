"""Ports on the loopback interface, which only this host can reach."""

from __future__ import annotations

import socket

from fantwin.pipeline.runtime.stage import StageError

LOOPBACK = "127.0.0.1"


def check_free(port: int, key: str, alternative: str = "") -> None:
    """Check that a port can be bound, because Rerun only logs a line if it cannot.

    Args:
        port: to check on the loopback.
        key: the setting that names the port, with its section; the error begins with it.
        alternative: what else the user can do, for the error.

    Raises:
        StageError: the port is taken.
    """
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((LOOPBACK, port))
        except OSError as error:
            or_else = f", or {alternative}" if alternative else ""
            raise StageError(
                f"{key}: port {port} on {LOOPBACK} is taken ({error.strerror}); set another one{or_else}"
            ) from error
