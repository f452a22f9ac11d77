"""Simulated device: a pseudo-terminal that speaks the wire protocol in real time.

`play` is its main loop. It never blocks and never waits for the reader: samples that nobody reads are counted and keep
their sequence numbers, so that a reader sees the gap. The samples themselves come from a `Device`.
"""

from __future__ import annotations

import array
import errno
import fcntl
import math
import os
import select
import termios
import threading
import time
import tty
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from fantwin.pipeline.errors import UserError
from fantwin.schemas import wire
from fantwin.schemas.device_sample import DeviceSample

LATE_S = 0.02
"""A sample sent this much after its time counts as late."""
DRAIN_LIMIT_S = 3.0
_DRAINED_FOR_S = 0.1
_POLL_S = 0.01
_TAKEN_LIMIT_S = 0.5
_READ_BYTES = 4096
_COUNTER_OF_FAULT = {
    wire.FaultKind.WRONG_CRC: "bad_crc",
    wire.FaultKind.WRONG_VERSION: "wrong_kind",
    wire.FaultKind.UNKNOWN_TYPE: "wrong_kind",
    wire.FaultKind.WRONG_TYPE: "wrong_kind",
    wire.FaultKind.WRONG_FAN_COUNT: "wrong_kind",
}
"""the counter of a device for each fault of its input; any other fault counts as a bad length"""


class Device(Protocol):
    """Gives samples one after the other, and takes commands."""

    @property
    def fans(self) -> int:
        """Number of fans in every sample."""
        ...

    def due_s(self) -> float | None:
        """Time of the next sample, seconds since the device started; None after the last."""
        ...

    def take(self) -> DeviceSample:
        """Measure the next sample."""
        ...

    def command(self, values: NDArray[np.float64]) -> None:
        """Commands (fans,) from the host; NaN leaves a fan unchanged."""
        ...

    def set_point(self, values_rad_s: NDArray[np.float64]) -> None:
        """Set-points (fans,) from the host, rad/s; NaN leaves a fan unchanged."""
        ...


class PseudoTerminal:
    """The device end of a serial line. The host end is a path, `port`, that any serial library can open.

    It does not keep the host end open itself, so that it can see whether a reader does. The line survives its reader.
    """

    def __init__(self, link: Path | None = None) -> None:
        """Open a line; `link` becomes a symbolic link to its port until `close`.

        Raises:
            UserError: the link cannot be created, or another kind of file has its name.
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

    def has_reader(self) -> bool:
        """Return whether a process holds the host end open."""
        return not any(events & select.POLLHUP for _, events in self._poll.poll(0))

    def write(self, data: bytes) -> bool:
        """Send a frame if there is a reader and the system has room; never a part of one."""
        if not self.has_reader() or not self.flush():
            return False
        written = self._write(data)
        self._pending = data[written:] if written else b""
        return written > 0

    def flush(self) -> bool:
        """Send the rest of a frame that was written in part; returns whether none is left."""
        if self._pending:
            self._pending = self._pending[self._write(self._pending) :]
        return not self._pending

    def _write(self, data: bytes) -> int:
        try:
            return os.write(self._master, data)
        except BlockingIOError:
            return 0

    def wait(self, timeout_s: float) -> bytes:
        """Bytes from the host within timeout_s; empty at once if there is no reader."""
        if not select.select([self._master], [], [], timeout_s)[0]:
            return b""
        try:
            return os.read(self._master, _READ_BYTES)
        except OSError as error:
            if error.errno != errno.EIO:  # no reader
                raise
            return b""

    def drain(self, limit_s: float) -> int:
        """Wait until the reader has read everything; returns the bytes unread after limit_s, or when it closed."""
        if not self.has_reader():
            return len(self._pending)
        deadline_s = time.monotonic() + limit_s
        # Only the host end says how many bytes wait to be read.
        slave = os.open(self.port, os.O_RDONLY | os.O_NOCTTY | os.O_NONBLOCK)
        try:
            empty_since_s = None
            while True:
                now_s = time.monotonic()
                left = _readable_bytes(slave) if self.flush() else 1
                # The system passes bytes on in portions, so the line has to stay empty for a while.
                empty_since_s = (empty_since_s or now_s) if left == 0 else None
                if now_s > deadline_s or (empty_since_s is not None and now_s - empty_since_s > _DRAINED_FOR_S):
                    return left + len(self._pending)
                time.sleep(_POLL_S)
        finally:
            os.close(slave)

    def close(self) -> None:
        """Close the line, as if the device was unplugged, and remove the link."""
        os.close(self._master)
        if self._link and self._link.is_symlink() and str(self._link.readlink()) == self.port:
            self._link.unlink()


def _make_link(link: Path, port: str) -> None:
    if link.exists() and not link.is_symlink():
        raise UserError(f"{link}: exists and is not a symbolic link; name another with --link")
    unfinished = link.with_name(f"{link.name}.{os.getpid()}")
    try:
        unfinished.symlink_to(port)
        unfinished.replace(link)
    except OSError as error:
        raise UserError(f"{link}: cannot create the link: {error.strerror}; name another with --link") from error


def _readable_bytes(slave: int) -> int:
    count = array.array("i", [0])
    fcntl.ioctl(slave, termios.FIONREAD, count)
    return count[0]


@dataclass
class PlaybackCounts:
    """Counts of a finished or running playback."""

    start_ns: int | None = None
    """epoch time of t_s = 0; None before the start"""
    samples_sent: int = 0
    samples_dropped: int = 0
    """simulated losses"""
    samples_unsent: int = 0
    """samples without a reader, or with one that was too slow"""
    samples_late: int = 0
    worst_lateness_s: float = 0.0
    commands_received: int = 0
    set_points_received: int = 0
    commands_refused: int = 0
    """parts of the stream from the host that are not a frame for this device"""
    bytes_unread: int = 0
    """sent, but unread when the line was closed"""

    def note_lateness(self, lateness_s: float, on_late: Callable[[float], Any]) -> None:
        """A sample is sent this much after its time. on_late: called if that is late."""
        self.worst_lateness_s = max(self.worst_lateness_s, lateness_s)
        if lateness_s > LATE_S:
            self.samples_late += 1
            on_late(lateness_s)


def wait_for_reader(line: PseudoTerminal, protocol: wire.Protocol, stop: threading.Event) -> None:
    """Return when a reader takes what is sent, or when `stop` is set.

    Serial libraries discard what has arrived when they have set up a port, which may be long after they opened it. So a
    delimiter, which is no frame, is sent until one has been taken.
    """
    while not stop.is_set():
        if line.has_reader() and line.write(wire.DELIMITERS[protocol]):
            is_taken = line.drain(_TAKEN_LIMIT_S) == 0
            if is_taken and line.has_reader():
                return
        stop.wait(_POLL_S)


def play(
    device: Device,
    line: PseudoTerminal,
    protocol: wire.Protocol,
    rad_s_per_unit: float,
    stop: threading.Event,
    on_start: Callable[[int], Any] = lambda _start_ns: None,
    on_late: Callable[[float], Any] = lambda _lateness_s: None,
) -> PlaybackCounts:
    """Send every sample at its time, by a schedule that does not drift, until the last one or until `stop` is set; in
    the binary form also once a second what the device has counted.

    rad_s_per_unit: unit of speed on the line. on_start: called with the epoch time of t_s = 0, ns. on_late: called with
    the lateness of each late sample, s. After a delay of the process, missed samples are sent as fast as possible; they
    keep their times.
    """
    played = PlaybackCounts()
    decoder = wire.Decoder(protocol, device.fans, end="device")
    counters: Counter[str] = Counter()
    counters_due_s = 0.0
    if stop.is_set():
        return played
    start_s, played.start_ns = time.monotonic(), time.time_ns()
    on_start(played.start_ns)
    while (due_s := device.due_s()) is not None:
        _receive_until(start_s + due_s, device, line, decoder, rad_s_per_unit, stop, played, counters)
        if stop.is_set():
            break
        played.note_lateness(time.monotonic() - start_s - due_s, on_late)
        sample = device.take()
        if sample.lost:
            played.samples_dropped += 1
        elif line.write(wire.encode(protocol, _frame(sample, rad_s_per_unit))):
            played.samples_sent += 1
        else:
            played.samples_unsent += 1
            counters["unsent_samples"] += 1
        if protocol == "binary" and due_s >= counters_due_s and line.write(_counters_frame(due_s, counters)):
            counters_due_s = math.floor(due_s) + 1.0
    played.bytes_unread = line.drain(DRAIN_LIMIT_S)
    return played


def _frame(sample: DeviceSample, rad_s_per_unit: float) -> wire.Sample:
    speed = sample.speed_rad_s / rad_s_per_unit
    auxiliary = {name: tuple(values.tolist()) for name, values in sample.auxiliary.items()}
    command = tuple(sample.command.tolist())
    return wire.Sample(sample.clock_us, sample.sequence, command, tuple(speed.tolist()), auxiliary)


def _counters_frame(uptime_s: float, counters: Counter[str]) -> bytes:
    counts = tuple(counters[name] % wire.UINT16 for name in wire.DEVICE_COUNTERS)
    return wire.encode("binary", wire.DeviceCounters(int(uptime_s), counts))


def _receive_until(
    deadline_s: float,
    device: Device,
    line: PseudoTerminal,
    decoder: wire.Decoder,
    rad_s_per_unit: float,
    stop: threading.Event,
    played: PlaybackCounts,
    counters: Counter[str],
) -> None:
    """Pass frames from the host to the device until deadline_s (monotonic); reads at least once."""
    while not stop.is_set():
        left_s = min(max(deadline_s - time.monotonic(), 0.0), 0.1)
        data = line.wait(left_s)
        for frame in decoder.feed(data):
            counters["frames"] += isinstance(frame, wire.CommandFrame | wire.SetPointFrame)
            if isinstance(frame, wire.CommandFrame):
                played.commands_received += 1
                device.command(np.array(frame.command))
            elif isinstance(frame, wire.SetPointFrame):
                played.set_points_received += 1
                device.set_point(np.array(frame.set_point) * rad_s_per_unit)
            elif isinstance(frame, wire.Fault):
                played.commands_refused += 1
                counters[_COUNTER_OF_FAULT.get(frame.kind, "bad_length")] += frame.kind is not wire.FaultKind.RESYNC
        left_s = deadline_s - time.monotonic()
        if left_s <= 0.0:
            return
        if not data and not line.has_reader():
            stop.wait(min(left_s, 0.1))
