"""Blocks of samples: what a source delivers within the time of one message reaches the stage together.

So a stage with a line of 100 samples a second is woken 20 times a second, not 100 times. The rule is the same for all
sources. Readings are handed over as soon as the next ones, by the time between
the last two arrivals, would come later than the time of a message: so a slow line is not delayed. If the next ones do
not arrive, the stage takes the waiting ones at its next tick.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

from fantwin.pipeline.sources.source import LinkDown, LinkUp, Reading, ReadingBatch, SampleSource, SourceEvent


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
