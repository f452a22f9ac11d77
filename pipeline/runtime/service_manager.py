"""Says that this process is ready and at work, to whoever started it: the launcher, or systemd.

The protocol is systemd's (man sd_notify): a datagram of lines to the Unix socket that the environment names. A stage
sends one while it goes round its loop, so that silence means that it hangs. Where nobody can listen to a socket, as in
a container with probes, the environment may name a file instead, whose time of change is renewed as often.

A stage that reports a problem is still at work: a full disk or a silent line does not go away by a restart, which only
loses what the stage keeps for others.
"""

from __future__ import annotations

import os
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

VARIABLE = "NOTIFY_SOCKET"
FILE_VARIABLE = "FANTWIN_ALIVE_FILE"
PERIOD_S = 0.25
BUILD_LIMIT_S = 600.0
"""how long building a stage may take: the repair of a large recording, or a router that is not there yet"""


class SignsOfLife:
    """Sends the notices of one process; does nothing where nobody asked for them. Never blocks, never raises."""

    def __init__(self, address: str | None, file: Path | None = None) -> None:
        """address: a path, or a name that begins with `@` for Linux's abstract sockets. file: one that is renewed.
        None: nobody asked for it."""
        self._file = file
        self._address = f"\0{address[1:]}" if address and address.startswith("@") else address
        self._socket: socket.socket | None = None
        self._next_s = 0.0
        self._is_ready = False
        if self._address:
            self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
            self._socket.setblocking(False)

    @classmethod
    def from_environment(cls) -> SignsOfLife:
        """The signs of life that the environment asks for."""
        file = os.environ.get(FILE_VARIABLE)
        return cls(os.environ.get(VARIABLE), Path(file) if file else None)

    def ready(self) -> None:
        """The process has started: from now on every notice says so, since one may be lost."""
        self._is_ready = True
        self._next_s = 0.0

    def at_work(self, status: str) -> None:
        """The main loop has run; sent every `PERIOD_S` at most. status: one line for people."""
        now_s = time.monotonic()
        if now_s < self._next_s:
            return
        self._next_s = now_s + PERIOD_S
        if self._file is not None:
            with suppress(OSError):
                self._file.touch()
        lines = [*(["READY=1"] if self._is_ready else []), "WATCHDOG=1", f"STATUS={' '.join(status.split())}"]
        self._send("\n".join(lines))

    def stopping(self) -> None:
        """The process ends in order."""
        self._send("STOPPING=1")

    def _send(self, text: str) -> None:
        if self._socket is None:
            return
        try:
            self._socket.sendto(text.encode(), self._address or "")
        except OSError:  # nobody listens any more, or is behind
            return


@contextmanager
def starting(limit_s: float = BUILD_LIMIT_S) -> Iterator[None]:
    """While the body builds a stage, a thread says that the process is at work, for limit_s at most."""
    signs, built = SignsOfLife.from_environment(), threading.Event()

    def repeat() -> None:
        until_s = time.monotonic() + limit_s
        while time.monotonic() < until_s and not built.wait(PERIOD_S):
            signs.at_work("starting")

    thread = threading.Thread(target=repeat, name="notices", daemon=True)
    thread.start()
    try:
        yield
    finally:
        built.set()
        thread.join()
