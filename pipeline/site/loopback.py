"""Ports on the loopback interface, which only this host can reach."""

from __future__ import annotations

from fantwin.pipeline.http_server import listening_socket
from fantwin.pipeline.runtime.stage import StageError

LOOPBACK = "127.0.0.1"


def check_free(port: int, key: str, alternative: str) -> None:
    """Check that a port can be bound, because Rerun only logs a line if it cannot.

    Args:
        port: to check on the loopback.
        key: the setting that names the port, with its section; the error begins with it.
        alternative: what else the user can do, for the error.

    Raises:
        StageError: the port is taken.
    """
    try:
        listening_socket(LOOPBACK, port).close()
    except OSError as error:
        taken = f"{key}: port {port} on {LOOPBACK} is taken ({error.strerror})"
        raise StageError(f"{taken}; set another one, or {alternative}") from error
