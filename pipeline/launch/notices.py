"""Receives what a child process reports by systemd's protocol; see `pipeline.runtime.service_manager`."""

from __future__ import annotations

import os
import secrets
import socket

_MAX_BYTES = 4096


class Notices:
    """The socket of one child. Only on Linux: its name is an abstract one, which leaves no file behind."""

    def __init__(self) -> None:
        """Open the socket.

        Raises:
            OSError: the system is out of memory or open files.
        """
        self.address = f"@fantwin-{os.getpid()}-{secrets.token_hex(8)}"
        """value of NOTIFY_SOCKET for the child"""
        self.is_ready = False
        self.status = ""
        """its last status line"""
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        try:
            self._socket.setblocking(False)
            self._socket.bind(f"\0{self.address[1:]}")
        except OSError:
            self._socket.close()
            raise

    def read(self) -> bool:
        """Read all that has arrived; returns whether the child's main loop has run since the last call."""
        was_at_work = False
        while True:
            try:
                data = self._socket.recv(_MAX_BYTES)
            except OSError:  # nothing more
                return was_at_work
            for line in data.decode(errors="replace").split("\n"):
                name, _, value = line.partition("=")
                was_at_work |= name == "WATCHDOG"
                self.is_ready |= name == "READY"
                self.status = value if name == "STATUS" else self.status

    def close(self) -> None:
        """Release the socket."""
        self._socket.close()
