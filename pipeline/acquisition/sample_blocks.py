"""Messages of raw samples, made of what a source delivers within the time of one message; and what a device has lost.

A stage with a line of 100 samples a second is woken 20 times a second, not 100 times. The rule is the same for all
sources. Readings are handed over as soon as the next ones, by the time between the last two arrivals, would come later
than the time of a message: so a slow line is not delayed. If the next ones do not arrive, the stage takes the waiting
ones at its next tick.
"""

from __future__ import annotations

import threading
from collections import Counter, deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np

from fantwin.pipeline.config.settings import TrayConfig
from fantwin.pipeline.sources.source import LinkDown, LinkUp, Reading, ReadingBatch, SampleSource, SourceEvent
from fantwin.pipeline.timebase.device_clock import LARGEST_GAP, UINT32
from fantwin.schemas.channels import CHANNELS
from fantwin.schemas.messages import Array, Raw, StatedTacho
from fantwin.schemas.units import RAD_S_PER_UNIT

_RECENT_SAMPLES = 64  # how far back a repeated sample is recognised


class DeviceSequence:
    """Follows the sequence numbers of one device: which samples were lost, repeated, or follow a restart of the device.

    Samples that were refused are lost. The gap that they leave in the sequence shows it; until there is a gap, or where
    there is no sequence, they are counted as `lost_refused`.
    """

    def __init__(self) -> None:
        self.refused = 0
        """samples refused since the last that was used"""
        self._last: int | None = None
        self._recent: deque[tuple[int, int | None]] = deque(maxlen=_RECENT_SAMPLES)

    def connection_interrupted(self) -> None:
        """The device may have been restarted: a number seen before may now belong to a new sample."""
        self._recent.clear()

    def is_new(self, reading: Reading, counts: Counter[str]) -> bool:
        """Return whether the reading is new; counts `lost_on_line`, `lost_refused`, `repeated` and
        `device_restarts`."""
        is_shown = False
        if reading.sequence is not None and self._last is not None:
            step = (reading.sequence - self._last) % UINT32
            is_shown = 1 <= step <= LARGEST_GAP
            if step != 1:
                if (reading.sequence, reading.clock_us) in self._recent:
                    counts["repeated"] += 1
                    return False
                if 1 < step <= LARGEST_GAP:
                    counts["lost_on_line"] += step - 1
                else:
                    counts["device_restarts"] += 1
        if self.refused and not is_shown:
            counts["lost_refused"] += self.refused
        self.refused = 0
        if reading.sequence is not None:
            self._last = reading.sequence
            self._recent.append((reading.sequence, reading.clock_us))
        return True


@dataclass(frozen=True, slots=True)
class ReceivedReading:
    """A reading that will be published, and its time of receipt."""

    reading: Reading
    t_ns: int

    @property
    def columns(self) -> tuple[bool, ...]:
        """Presence of each optional column: the samples of one message must agree."""
        reading = self.reading
        return (
            reading.clock_us is not None,
            reading.sequence is not None,
            *(each.name in reading.measured for each in CHANNELS),
        )


def raw_message(block: Sequence[ReceivedReading], tray: TrayConfig, tachos: tuple[StatedTacho, ...] = ()) -> Raw:
    """Make one message of samples that agree in their columns. tachos: what their source states to measure."""
    readings = [received.reading for received in block]
    measured: dict[str, Any] = {
        name: np.array([reading.measured[name] for reading in readings], np.float32) for name in readings[0].measured
    }
    return Raw(
        fans=tray.fans,
        host_receive_t_ns=np.array([received.t_ns for received in block], np.int64),
        device_clock_us=_uint32(r.clock_us for r in readings),
        device_sequence=_uint32(r.sequence for r in readings),
        command=np.array([r.command for r in readings], np.float64),
        speed_rad_s=np.array([r.speed for r in readings], np.float64) * RAD_S_PER_UNIT[tray.speed_unit],
        tachos=tachos,
        **measured,
    )


def _uint32(values: Iterable[int | None]) -> Array:
    """A column of numbers that wrap at 2^32; empty if the samples have none."""
    return np.array([value % UINT32 for value in values if value is not None], np.uint32)


@dataclass(frozen=True, slots=True, eq=False)
class ReadingBlock:
    """Readings that arrived within the time of one message; each batch keeps its own time of receipt."""

    batches: tuple[ReadingBatch, ...]


BlockEvent: TypeAlias = ReadingBlock | LinkUp | LinkDown


class SampleBlocks:
    """A source whose readings come in blocks. It delivers in the thread of the source that it is made of."""

    def __init__(self, source: SampleSource, block_ns: int) -> None:
        """block_ns: the time of a block; 0: each batch with readings is one."""
        self.source = source
        self._block_ns = block_ns
        self._deliver: Callable[[BlockEvent], None] = lambda _event: None
        self._lock = threading.Lock()
        self._waiting: list[ReadingBatch] = []
        self._first_t_ns: int | None = None
        """time of receipt of the first readings that wait; None: none wait"""
        self._arrived_t_ns = 0
        """time of receipt of the last readings"""
        self._delivered: BlockEvent | None = None
        """the last event: what waits now comes after it"""

    def start(self, deliver: Callable[[BlockEvent], None]) -> None:
        """Start the source; `deliver` blocks while the stage is behind."""

        def take(event: SourceEvent) -> None:
            for each in self.add(event):
                deliver(each)

        self._deliver = deliver
        self.source.start(take)

    def stop(self) -> None:
        """Stop the source, and deliver what still waits."""
        self.source.stop()
        with self._lock:
            rest = self._end_block()
        for block in rest:
            self._deliver(block)

    def add(self, event: SourceEvent) -> list[BlockEvent]:
        """Take an event of the source; return what is to be delivered now."""
        with self._lock:
            if not isinstance(event, ReadingBatch):
                due: list[BlockEvent] = [*self._end_block(), event]
                self._delivered = event
                return due
            self._waiting.append(event)
            until_t_ns, first_t_ns = event.received_t_ns, self._waiting[0].received_t_ns
            if any(isinstance(item, Reading) for item in event.items):
                if self._first_t_ns is None:
                    self._first_t_ns = event.received_t_ns
                until_t_ns, first_t_ns = 2 * event.received_t_ns - self._arrived_t_ns, self._first_t_ns
                self._arrived_t_ns = event.received_t_ns
            return self._end_block() if until_t_ns - first_t_ns >= self._block_ns else []

    def take_waiting(self, now_ns: int, processed: BlockEvent | None) -> ReadingBlock | None:
        """Take what has waited for the time of a block and would come next; None if there is nothing.

        processed: the event that the stage processed last. While another one is on its way to the stage, nothing is
        taken before it.
        """
        with self._lock:
            is_due = self._waiting and now_ns - self._waiting[0].received_t_ns >= self._block_ns
            if not is_due or self._delivered is not processed:
                return None
            return self._block()

    def take_rest(self) -> ReadingBlock | None:
        """All that waits, None if nothing does: for a stage that ends although its source has not."""
        with self._lock:
            return self._block() if self._waiting else None

    def _end_block(self) -> list[BlockEvent]:
        if not self._waiting:
            return []
        self._delivered = block = self._block()
        return [block]

    def _block(self) -> ReadingBlock:
        block = ReadingBlock(tuple(self._waiting))
        self._waiting.clear()
        self._first_t_ns = None
        return block
