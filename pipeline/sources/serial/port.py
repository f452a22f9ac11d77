"""A serial port as a stream of bytes: opened, read in a thread of its own, and reopened whenever it comes back.

This is the only module that uses pyserial. The path of a pseudo-terminal works like that of a device.
"""

from __future__ import annotations

import errno
import os
import select
import termios
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

import serial

from fantwin.pipeline.sources.serial.same_port import SamePort, ports_there
from fantwin.pipeline.sources.source import LinkDown, LinkUp, Noted
from fantwin.pipeline.timebase.host_clock import HOST_CLOCK

READ_TIMEOUT_S = 0.1
MOST_READ_BYTES = 1 << 16
WRITE_TIMEOUT_S = 0.05  # a device that takes no bytes must not delay the samples that come from it
DRAIN_LIMIT_S = 0.5  # a device that never pauses must not delay the end
REOPEN_DELAY_S = 0.1  # doubles with every attempt, up to the maximum
REOPEN_DELAY_MAX_S = 2.0

_OPEN_PROBLEMS = {
    errno.EACCES: "not allowed to open it; add this user to the port's group (often dialout)",
    errno.EPERM: "not allowed to open it; add this user to the port's group (often dialout)",
    errno.EBUSY: "in use by another program; stop that one",
    errno.EWOULDBLOCK: "in use by another program; stop that one",
}
_DISCONNECTED = "the device was disconnected; waiting for it to come back"
# pyserial's errors are OSErrors, but it passes on those of termios, and raises ValueError for an impossible baud rate.
_PORT_ERRORS = (OSError, termios.error, ValueError)


@dataclass(frozen=True, slots=True)
class ReceivedBytes:
    """Bytes that arrived together, and the host time at which they did, ns since the epoch."""

    data: bytes
    received_t_ns: int


class SerialPort:
    """Delivers `LinkUp`, `ReceivedBytes`, `LinkDown` and what else is noted of the port, and takes bytes to write."""

    def __init__(self, port: str, baud: int) -> None:
        self._name = port
        self._same = SamePort(port)
        self._baud = baud
        self._port: serial.Serial | None = None
        self._port_lock = threading.Lock()  # a port is not closed while it is written to
        self._stopping = threading.Event()
        self._thread: threading.Thread | None = None

    def start(self, deliver: Callable[[LinkUp | LinkDown | Noted | ReceivedBytes], None]) -> None:
        """Open and read in a thread; wait for a port that does not exist yet."""
        self._thread = threading.Thread(target=self._run, args=(deliver,), name=f"read {self._name}", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Deliver what the system has received so far, until nothing arrives for a moment, then end."""
        self._stopping.set()
        if self._thread:
            self._thread.join()

    def write(self, data: bytes) -> bool:
        """Send bytes; False if the port is not open or did not take all of them within `WRITE_TIMEOUT_S`."""
        with self._port_lock:
            if self._port is None:
                return False
            try:
                return self._port.write(data) == len(data)
            except _PORT_ERRORS:
                return False  # the reading thread gets the same error and reports it

    def _run(self, deliver: Callable[[LinkUp | LinkDown | Noted | ReceivedBytes], None]) -> None:
        delay_s = REOPEN_DELAY_S
        reported = ""
        while not self._stopping.is_set():
            try:
                path = self._same.path()
                port = self._open(path)
            except _PORT_ERRORS as error:
                reason = _open_problem(error, self._name)
            else:
                with self._port_lock:
                    self._port = port
                deliver(LinkUp())
                if change := self._same.opened(path):
                    deliver(Noted("port_changed", change))
                if self._read_until_disconnected(port, deliver):
                    delay_s = (
                        REOPEN_DELAY_S  # it worked; only a port that opens and gives no byte is retried more slowly
                    )
                with self._port_lock:
                    self._port = None
                    port.close()
                reason, reported = _DISCONNECTED, ""
            if self._stopping.is_set():
                return
            if reason != reported:
                deliver(LinkDown(reason))
                reported = reason
            self._stopping.wait(delay_s)
            delay_s = min(2 * delay_s, REOPEN_DELAY_MAX_S)

    def _open(self, path: str) -> serial.Serial:
        return serial.Serial(path, self._baud, timeout=READ_TIMEOUT_S, write_timeout=WRITE_TIMEOUT_S, exclusive=True)

    def _read_until_disconnected(self, port: serial.Serial, deliver: Callable[[ReceivedBytes], None]) -> bool:
        """Deliver until the device is disconnected or `stop` is called; returns whether any byte arrived."""
        any_received = False
        drain_until_s = None
        descriptor = port.fileno()
        arrival = select.poll()
        arrival.register(descriptor, select.POLLIN)
        while True:
            if self._stopping.is_set():
                drain_until_s = drain_until_s or time.monotonic() + DRAIN_LIMIT_S
            # not with `port.read`, which asks the system four times for what one read gives
            data = b""
            if arrival.poll(READ_TIMEOUT_S * 1000):
                try:
                    data = os.read(descriptor, MOST_READ_BYTES)
                except BlockingIOError:
                    continue
                except OSError:
                    return any_received
                if not data:
                    return any_received
                any_received = True
                deliver(ReceivedBytes(data, HOST_CLOCK.now_ns()))
            if drain_until_s and (not data or time.monotonic() > drain_until_s):
                return any_received


def _open_problem(error: Exception, port: str) -> str:
    """Problem with the port and what to do, in one line."""
    number = error.errno if isinstance(error, OSError) else None
    if number == errno.ENOENT:
        return f"no such port; waiting for it; check [[tray]] port; {ports_there(port)}"
    return (
        _OPEN_PROBLEMS.get(number or 0) or f"cannot be opened ({error}); waiting for it; check [[tray]] port and baud"
    )
