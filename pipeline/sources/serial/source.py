"""The serial line as a source of samples: the wire protocol of docs/reference/wire-protocol.md on a serial port."""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Callable, Mapping
from typing import Protocol

from fantwin.pipeline.errors import UserError
from fantwin.pipeline.sources.serial.config import SerialConfig
from fantwin.pipeline.sources.serial.port import ReceivedBytes, SerialPort
from fantwin.pipeline.sources.serial.same_port import ports_there
from fantwin.pipeline.sources.source import (
    LinkDown,
    LinkUp,
    Noted,
    Reading,
    ReadingBatch,
    Rejected,
    SourceContext,
    SourceEvent,
    too_many_fans,
)
from fantwin.pipeline.timebase.host_clock import HOST_CLOCK
from fantwin.schemas import wire
from fantwin.schemas.wire import DEVICE_COUNTERS, UINT16, UINT32, DeviceCounters

_WRAPS_FROM_S = UINT32 // 100 - 60
"""an uptime that a device derives from the 32-bit number of its samples, at most 100 a second, wraps a minute later at
the earliest: some frames before the wrap may be lost"""


class DeviceCounterSteps:
    """Follows the counters of one device, such as that of damaged frames: how far they advanced as it was read.

    They wrap, and start again at 0 when the device restarts.

    A device has restarted if its uptime is smaller than before, and is not one that may have wrapped; or if a counter
    went back: by less than half its range, since a step forward of more than that within a second or two is no count.
    A restart that shows neither, because all counters have passed their earlier values since, counts too little. The
    host's clock is no evidence: after it was busy, what the device has sent meanwhile arrives late and at once.
    """

    def __init__(self) -> None:
        self._last: DeviceCounters | None = None
        self._was_interrupted = True

    def connection_interrupted(self) -> None:
        """Leave out what the device counts until its next frame, unless the device restarts meanwhile."""
        self._was_interrupted = True

    def steps(self, now: DeviceCounters) -> Mapping[str, int]:
        """The advance of each counter since the frame before, by the names of `DEVICE_COUNTERS`. If the device has
        restarted: since the restart. Otherwise 0 for the first frame after an interruption."""
        last, self._last = self._last, now
        was_interrupted, self._was_interrupted = self._was_interrupted, False
        if last is not None and _has_restarted(last, now, was_interrupted=was_interrupted):
            before = (0,) * len(now.counts)
        elif last is None or was_interrupted or len(last.counts) != len(now.counts):
            before = now.counts
        else:
            before = last.counts
        return dict(zip(DEVICE_COUNTERS, _advance(before, now.counts), strict=False))


def _has_restarted(last: DeviceCounters, now: DeviceCounters, *, was_interrupted: bool) -> bool:
    went_back = any(step > UINT16 // 2 for step in _advance(last.counts, now.counts))
    if now.uptime_s < last.uptime_s:
        return went_back or last.uptime_s < _WRAPS_FROM_S
    return went_back and not was_interrupted  # in a long interruption a counter may advance by any number


def _advance(before: tuple[int, ...], now: tuple[int, ...]) -> list[int]:
    return [(count - earlier) % UINT16 for count, earlier in zip(now, before, strict=False)]


_HARMLESS = (wire.FaultKind.RESYNC, wire.FaultKind.UNKNOWN_TYPE)
_REFUSED_SAMPLES = (wire.FaultKind.WRONG_FAN_COUNT, wire.FaultKind.BAD_COMMAND)


class ByteLink(Protocol):
    """Carries bytes both ways and knows no protocol. `SerialPort` says what each method does."""

    def start(self, deliver: Callable[[LinkUp | LinkDown | Noted | ReceivedBytes], None]) -> None: ...  # noqa: D102
    def stop(self) -> None: ...  # noqa: D102
    def write(self, data: bytes) -> bool: ...  # noqa: D102


class SerialSource:
    """A `SampleSource`. Frames are decoded in the thread that reads the port."""

    def __init__(self, config: SerialConfig, context: SourceContext, link: ByteLink | None = None) -> None:
        """Prepare the line; the port is not opened yet. A test may give another `link`.

        Raises:
            UserError: no port is given, or a frame cannot carry all fans.
        """
        if context.fans > wire.MAX_FANS:
            raise UserError(too_many_fans(config.kind, context.fans, wire.MAX_FANS))
        if not config.port:
            raise UserError('port is missing; add for example port = "/dev/ttyUSB0"')
        self._path = context.folder / config.port
        self._config = config
        self._link = link or SerialPort(str(self._path), config.baud)
        self._decoder = wire.Decoder(config.protocol, context.fans)
        self._device_counters = DeviceCounterSteps()
        self._fans = context.fans

    @property
    def name(self) -> str:
        """The port as the configuration names it."""
        return self._config.port

    @property
    def settings_to_check(self) -> str:
        """Settings that may differ between the two ends of the line."""
        return f"baud = {self._config.baud}, protocol = {self._config.protocol!r}"

    def start(self, deliver: Callable[[SourceEvent], None]) -> None:
        """Open and read the port in a thread of its own."""
        self._link.start(lambda item: deliver(self.decode(item)))

    def stop(self) -> None:
        """Deliver what has already arrived, then end."""
        self._link.stop()

    def decode(self, item: LinkUp | LinkDown | Noted | ReceivedBytes) -> SourceEvent:
        """Decode the readings that these bytes complete. Bytes that are not a frame are `Rejected`."""
        if isinstance(item, Noted):
            return ReadingBatch(HOST_CLOCK.now_ns(), (item,))
        if not isinstance(item, ReceivedBytes):
            self._decoder.reset()
            self._device_counters.connection_interrupted()
            return item
        readings: list[Reading | Rejected] = []
        device_counts: Counter[str] = Counter()
        for found in self._decoder.feed(item.data):
            if isinstance(found, wire.DeviceCounters):
                device_counts.update(self._device_counters.steps(found))
            else:
                readings.append(self._reading_of(found))
        return ReadingBatch(item.received_t_ns, readings, len(item.data), device_counts=device_counts)

    def send(self, command: tuple[float, ...], set_point: tuple[float, ...]) -> str:
        """Write one frame for commands and one for set-points, where a value is given."""
        frames = ((command, wire.CommandFrame(command)), (set_point, wire.SetPointFrame(set_point)))
        is_written = self._link.write(
            b"".join(
                wire.encode(self._config.protocol, frame)
                for values, frame in frames
                if not all(map(math.isnan, values))
            )
        )
        return "" if is_written else f"{self.name} is not connected, or accepted no bytes"

    def check(self) -> list[str]:
        """Problems before the start: the port does not exist or may not be opened."""
        if not self._path.exists():
            there = ports_there(str(self._path))
            return [f"{self._path}: no such port; connect the device, or correct [[tray]] port; {there}"]
        if not os.access(self._path, os.R_OK | os.W_OK):
            return [f"{self._path}: this user may not read and write it; join its group (often dialout)"]
        return []

    def _reading_of(self, found: wire.Frame | wire.Fault) -> Reading | Rejected:
        if isinstance(found, wire.Sample):
            return Reading(found.command, found.speed, found.clock_us, found.sequence, found.measured)
        assert isinstance(found, wire.Fault), "commands and set-points are not for the decoder of a host"
        return Rejected(
            found.kind.value,
            found.detail,
            harmless=found.kind in _HARMLESS,
            is_sample=found.kind in _REFUSED_SAMPLES,
            setting=f"fans = {self._fans}" if found.kind is wire.FaultKind.WRONG_FAN_COUNT else "",
        )
