"""A device that is not there: a pseudo-terminal that speaks the wire protocol in real time.

`play` is the device's main loop. It never blocks and never waits for its reader: what nobody takes is counted, and
keeps its sequence number, so that a reader sees the gap. What the samples are is the device's own affair (`Device`).
"""

from __future__ import annotations

import array
import errno
import fcntl
import os
import select
import termios
import threading
import time
import tty
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import UserError
from schemas import wire

LATE_S = 0.02
"""A sample sent later than this after it was due counts as late."""
DRAIN_LIMIT_S = 3.0
_DRAINED_FOR_S = 0.1
_LOOK_S = 0.01
# A reader that has just opened the port may still throw away what has come so far, as serial libraries do.
_SETTLE_S = 0.25
_READ_BYTES = 4096


class DeviceSample(Protocol):
    """What a device has measured at t_s, seconds since it began. A lost one is not to be sent."""

    @property
    def t_s(self) -> float: ...  # noqa: D102
    @property
    def clock_us(self) -> int: ...  # noqa: D102
    @property
    def sequence(self) -> int: ...  # noqa: D102
    @property
    def command(self) -> NDArray[np.float64]: ...  # noqa: D102
    @property
    def speed_rad_s(self) -> NDArray[np.float64]: ...  # noqa: D102
    @property
    def lost(self) -> bool: ...  # noqa: D102


class Device(Protocol):
    """Something that gives samples, one after the other, and takes commands."""

    @property
    def fans(self) -> int:
        """How many fans every sample carries."""
        ...

    def due_s(self) -> float | None:
        """When the next sample is due, seconds since the device began; None after the last."""
        ...

    def take(self) -> DeviceSample:
        """Measure the next sample."""
        ...

    def command(self, values: NDArray[np.float64]) -> None:
        """Commands (fans,) that came down the line; NaN leaves a fan as it is."""
        ...

    def set_point(self, values_rad_s: NDArray[np.float64]) -> None:
        """Set-points (fans,) that came down the line, rad/s; NaN leaves a fan as it is."""
        ...


class PseudoTerminal:
    """The device's end of a line. Its other end is a path, `port`, that any serial library can open.

    It holds no descriptor of the other end, so that it knows whether somebody else does; a reader that dies leaves
    the line as it is, for the next one.
    """

    def __init__(self, link: Path | None = None) -> None:
        """Open a line; `link` becomes a symbolic link to its path, and is removed again by `close`.

        Raises:
            UserError: the link cannot be made, or something that is no link stands in its place.
        """
        self._master, slave = os.openpty()
        tty.setraw(slave)
        self.port = os.ttyname(slave)
        os.close(slave)
        os.set_blocking(self._master, False)
        self._poll = select.poll()
        self._poll.register(self._master, 0)
        self._pending = b""
        self._link = link
        if link:
            try:
                _make_link(link, self.port)
            except UserError:
                os.close(self._master)
                raise

    def somebody_reads(self) -> bool:
        """Whether any process holds the other end open."""
        return not any(events & select.POLLHUP for _, events in self._poll.poll(0))

    def write(self, data: bytes) -> bool:
        """Send a frame if somebody is there to read it and the system has room; never half of one."""
        if not self.somebody_reads() or not self.flush():
            return False
        written = self._write(data)
        self._pending = data[written:] if written else b""
        return written > 0

    def flush(self) -> bool:
        """Send the rest of a frame that found room for its beginning only; whether none is left."""
        if self._pending:
            self._pending = self._pending[self._write(self._pending) :]
        return not self._pending

    def _write(self, data: bytes) -> int:
        try:
            return os.write(self._master, data)
        except BlockingIOError:
            return 0

    def wait(self, timeout_s: float) -> bytes:
        """What comes down the line, at the latest after timeout_s; empty at once if nobody holds the other end."""
        if not select.select([self._master], [], [], timeout_s)[0]:
            return b""
        try:
            return os.read(self._master, _READ_BYTES)
        except OSError as error:
            if error.errno != errno.EIO:  # nobody holds the other end
                raise
            return b""

    def drain(self, limit_s: float) -> int:
        """Wait until the reader has taken everything; bytes it had not taken after limit_s, or when it left."""
        if not self.somebody_reads():
            return len(self._pending)
        deadline_s = time.monotonic() + limit_s
        # Only the other end tells how much waits there to be read.
        slave = os.open(self.port, os.O_RDONLY | os.O_NOCTTY | os.O_NONBLOCK)
        try:
            empty_since_s = None
            while True:
                now_s = time.monotonic()
                left = _readable_bytes(slave) if self.flush() else 1
                # The system hands bytes on in portions: empty means empty for a while.
                empty_since_s = (empty_since_s or now_s) if left == 0 else None
                if now_s > deadline_s or (empty_since_s is not None and now_s - empty_since_s > _DRAINED_FOR_S):
                    return left + len(self._pending)
                time.sleep(_LOOK_S)
        finally:
            os.close(slave)

    def close(self) -> None:
        """Let the device vanish: the reader sees the end of the line, and the link is gone."""
        os.close(self._master)
        if self._link and self._link.is_symlink() and str(self._link.readlink()) == self.port:
            self._link.unlink()


def _make_link(link: Path, port: str) -> None:
    if link.exists() and not link.is_symlink():
        raise UserError(f"{link}: is there already and is no symbolic link; name another with --link")
    unfinished = link.with_name(f"{link.name}.{os.getpid()}")
    try:
        unfinished.symlink_to(port)
        unfinished.replace(link)
    except OSError as error:
        raise UserError(f"{link}: the link cannot be made: {error.strerror}; name another with --link") from error


def _readable_bytes(slave: int) -> int:
    count = array.array("i", [0])
    fcntl.ioctl(slave, termios.FIONREAD, count)
    return count[0]


@dataclass
class Played:
    """What became of the samples."""

    start_ns: int | None = None
    """epoch time of the device's t_s = 0; None if it never began"""
    samples_sent: int = 0
    samples_dropped: int = 0
    """simulated losses"""
    samples_unsent: int = 0
    """nobody read the line, or not fast enough"""
    samples_late: int = 0
    worst_lateness_s: float = 0.0
    commands_received: int = 0
    set_points_received: int = 0
    commands_refused: int = 0
    """pieces of the stream down the line that are no frame for this device"""
    bytes_unread: int = 0
    """sent, but still in the line when it was closed"""


def wait_for_reader(line: PseudoTerminal, stop: threading.Event) -> None:
    """Return when somebody has opened the line and kept it open, or when asked to stop."""
    while not stop.is_set():
        if line.somebody_reads():
            stop.wait(_SETTLE_S)
            if line.somebody_reads():
                return
        stop.wait(_LOOK_S)


def play(
    device: Device,
    line: PseudoTerminal,
    protocol: wire.Protocol,
    rad_s_per_unit: float,
    stop: threading.Event,
    began: Callable[[int], Any] = lambda _start_ns: None,
) -> Played:
    """Send every sample when it is due, by a schedule that does not drift, until the last one or until `stop`.

    rad_s_per_unit: the line's unit of speed. began: told the epoch time in ns of the device's t_s = 0. A process
    that was held up sends what it missed as fast as it can; the samples keep their own times.
    """
    played = Played()
    decoder = wire.Decoder(protocol, device.fans, end="device")
    if stop.is_set():
        return played
    start_s, played.start_ns = time.monotonic(), time.time_ns()
    began(played.start_ns)
    while (due_s := device.due_s()) is not None:
        _listen_until(start_s + due_s, device, line, decoder, rad_s_per_unit, stop, played)
        if stop.is_set():
            break
        lateness_s = time.monotonic() - start_s - due_s
        played.samples_late += lateness_s > LATE_S
        played.worst_lateness_s = max(played.worst_lateness_s, lateness_s)
        sample = device.take()
        if sample.lost:
            played.samples_dropped += 1
        elif line.write(wire.encode(protocol, _frame(sample, rad_s_per_unit))):
            played.samples_sent += 1
        else:
            played.samples_unsent += 1
    played.bytes_unread = line.drain(DRAIN_LIMIT_S)
    return played


def _frame(sample: DeviceSample, rad_s_per_unit: float) -> wire.Sample:
    speed = sample.speed_rad_s / rad_s_per_unit
    return wire.Sample(sample.clock_us, sample.sequence, tuple(sample.command.tolist()), tuple(speed.tolist()))


def _listen_until(
    deadline_s: float,
    device: Device,
    line: PseudoTerminal,
    decoder: wire.Decoder,
    rad_s_per_unit: float,
    stop: threading.Event,
    played: Played,
) -> None:
    """Take what comes down the line until deadline_s (monotonic), and look at least once."""
    while not stop.is_set():
        left_s = min(max(deadline_s - time.monotonic(), 0.0), 0.1)
        data = line.wait(left_s)
        for frame in decoder.feed(data):
            if isinstance(frame, wire.CommandFrame):
                played.commands_received += 1
                device.command(np.array(frame.command))
            elif isinstance(frame, wire.SetPointFrame):
                played.set_points_received += 1
                device.set_point(np.array(frame.set_point) * rad_s_per_unit)
            else:
                played.commands_refused += 1
        left_s = deadline_s - time.monotonic()
        if left_s <= 0.0:
            return
        if not data and not line.somebody_reads():
            stop.wait(min(left_s, 0.1))
