"""A serial port as a source of bytes: opened, read in a thread of its own, and opened again whenever it comes back.

The only module that knows pyserial. A pseudo-terminal's path is as good a port as a device's.
"""

from __future__ import annotations

import errno
import termios
import threading
import time
from collections.abc import Callable

import serial

from pipeline.devices.byte_link import LinkDown, LinkUp, Received

READ_TIMEOUT_S = 0.1
WRITE_TIMEOUT_S = 0.05  # a device that takes no bytes must not hold up the samples that come from it
DRAIN_LIMIT_S = 0.5  # a device that never pauses must not hold up the end
REOPEN_DELAY_S = 0.1  # doubles with every attempt, up to the largest
REOPEN_DELAY_MAX_S = 2.0

_WAITING = {
    errno.ENOENT: "no such port; waiting for it; check [[tray]] port",
    errno.EACCES: "not allowed to open it; add this user to the port's group (often dialout)",
    errno.EPERM: "not allowed to open it; add this user to the port's group (often dialout)",
    errno.EBUSY: "in use by another program; stop that one",
    errno.EWOULDBLOCK: "in use by another program; stop that one",
}
_GONE = "the device has gone; waiting for it to come back"
# pyserial's own errors are OSErrors, but it lets termios' through, and says ValueError to a baud rate it cannot set.
_PORT_ERRORS = (OSError, termios.error, ValueError)


class SerialPort:
    """Source of `LinkUp`, `Received` and `LinkDown`, and the `Line` that a core writes to."""

    def __init__(self, port: str, baud: int) -> None:
        self._name = port
        self._baud = baud
        self._port: serial.Serial | None = None
        self._port_lock = threading.Lock()  # a port is not closed while it is written to
        self._stopping = threading.Event()
        self._thread: threading.Thread | None = None

    def start(self, deliver: Callable[[LinkUp | LinkDown | Received], None]) -> None:
        """Begin to open and read in a thread; a port that is not there yet is waited for."""
        self._thread = threading.Thread(target=self._run, args=(deliver,), name=f"read {self._name}", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Deliver what the system has received so far, until the line is quiet for a moment, then end."""
        self._stopping.set()
        if self._thread:
            self._thread.join()

    def write(self, data: bytes) -> bool:
        """Send bytes; False if the line is down or did not take all of them within `WRITE_TIMEOUT_S`."""
        with self._port_lock:
            if self._port is None:
                return False
            try:
                return self._port.write(data) == len(data)
            except _PORT_ERRORS:
                return False  # the reader meets the same error and tells of it

    def _run(self, deliver: Callable[[LinkUp | LinkDown | Received], None]) -> None:
        delay_s = REOPEN_DELAY_S
        told = ""
        while not self._stopping.is_set():
            try:
                port = self._open()
            except _PORT_ERRORS as error:
                reason = _why_not_open(error)
            else:
                with self._port_lock:
                    self._port = port
                deliver(LinkUp(self._name))
                if self._read_until_gone(port, deliver):
                    delay_s = REOPEN_DELAY_S  # it did work: only what comes and goes without a byte is backed off from
                with self._port_lock:
                    self._port = None
                    port.close()
                reason, told = _GONE, ""
            if self._stopping.is_set():
                return
            if reason != told:
                deliver(LinkDown(reason))
                told = reason
            self._stopping.wait(delay_s)
            delay_s = min(2 * delay_s, REOPEN_DELAY_MAX_S)

    def _open(self) -> serial.Serial:
        return serial.Serial(
            self._name, self._baud, timeout=READ_TIMEOUT_S, write_timeout=WRITE_TIMEOUT_S, exclusive=True
        )

    def _read_until_gone(self, port: serial.Serial, deliver: Callable[[Received], None]) -> bool:
        """Deliver until the device goes or the line is stopped; whether anything came at all."""
        came = False
        drain_until_s = None
        while True:
            if self._stopping.is_set():
                drain_until_s = drain_until_s or time.monotonic() + DRAIN_LIMIT_S
            try:
                data = port.read(1)
                t_ns = time.time_ns()
                data += port.read(port.in_waiting)
            except _PORT_ERRORS:
                return came
            if data:
                came = True
                deliver(Received(data, t_ns))
            if drain_until_s and (not data or time.monotonic() > drain_until_s):
                return came


def _why_not_open(error: Exception) -> str:
    """One line for a person: what is wrong with the port and what to do."""
    number = error.errno if isinstance(error, OSError) else None
    return _WAITING.get(number or 0) or f"cannot be opened ({error}); waiting for it; check [[tray]] port and baud"
