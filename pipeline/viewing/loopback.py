"""Ports of this host that only this host can reach."""

from __future__ import annotations

import socket

from pipeline.runtime.stage import StageError

LOOPBACK = "127.0.0.1"


def check_free(port: int, key: str) -> None:
    """Rerun itself only writes a line into its log when a port is taken.

    Raises:
        StageError: the port is taken.
    """
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((LOOPBACK, port))
        except OSError as error:
            raise StageError(
                f"viewer.{key}: port {port} on {LOOPBACK} is taken ({error.strerror}); "
                f"set another one, or viewer.serve = false"
            ) from error
