"""A tray's recorded raw samples, in blocks, as each session of the first stage consumed them."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Generic, TypeVar

import numpy as np

from fantwin.pipeline.replay.offline.plan import Session, Span
from fantwin.schemas.blocks import cut
from fantwin.schemas.codec import decode_together
from fantwin.schemas.envelope import Envelope
from fantwin.schemas.messages import Grid, Message, Prediction, Raw, Score
from fantwin.schemas.units import NS_PER_S

Samples = TypeVar("Samples", bound=Grid | Prediction | Score)


class SampleStream(Generic[Samples]):
    """The samples that one session of a stage makes, for the sessions of the next stage that consume them.

    Blocks are made when they are asked for; those that a later span contains as well are kept until then.
    """

    def __init__(self, blocks: Iterator[Samples]) -> None:
        self._blocks = blocks
        self._kept: deque[Samples] = deque()

    def of(self, span: Span) -> Iterator[Samples]:
        """The samples of a span. Spans are asked for in the order of the plan."""
        for block in self._from_kept(span.wanted_again_from):
            first = int(np.searchsorted(block.t_ns, span.first, side="left"))
            end = len(block.t_ns)
            if span.last is not None:
                end = int(np.searchsorted(block.t_ns, span.last, side="right"))
            if first < end:
                yield block if (first, end) == (0, len(block.t_ns)) else cut(block, first, end)
            if span.last is not None and block.t_ns[-1] >= span.last:
                return

    def _from_kept(self, wanted_again_from: int | None) -> Iterator[Samples]:
        def is_wanted_again(block: Samples) -> bool:
            return wanted_again_from is not None and int(block.t_ns[-1]) >= wanted_again_from

        kept = tuple(self._kept)
        self._kept = deque(filter(is_wanted_again, kept))
        yield from kept
        for block in self._blocks:
            if is_wanted_again(block):
                self._kept.append(block)
            yield block


MOST_MESSAGES = 512
"""that a stage is given at once"""
LARGEST_BLOCK_BYTES = 2**20
"""of these messages together, unless one is larger"""


class RawBlocks:
    """Reads the raw messages once for each session, and counts those that are missing."""

    def __init__(
        self,
        read: Callable[[], Iterable[Envelope]],
        observe: Callable[[Message], None],
        stretch_s: tuple[float, float] = (0.0, math.inf),
    ) -> None:
        """read: the tray's raw messages in the order they were recorded, from the beginning at each call. observe: is
        given each sample once. stretch_s: the part to read, in seconds since the first sample."""
        self._read = read
        self._observe = observe
        self._stretch_s = stretch_s
        self._first_t_ns: int | None = None
        self._next_new: dict[str, int] = {}
        """of each producer: the first sequence number that no session has consumed yet"""
        self._gaps: dict[tuple[str, int], int] = {}
        """missing messages, by producer and first sequence number"""
        self.has_gap: set[str] = set()
        """sessions that consumed messages, before the next block they are given, that are missing"""

        self.is_past_known: set[str] = set()
        """sessions whose next block begins after the newest message that they certainly consumed"""
        self.samples_in_message = 1.0
        """on average, of the messages read first"""

    @property
    def missing(self) -> int:
        """Raw messages that a stage consumed, or that lie between recorded ones, and that are not in the recording."""
        return sum(self._gaps.values())

    def of(self, session: Session) -> Iterator[tuple[Raw, int | None]]:
        """The blocks of a session. A block ends where a timer made the session emit samples; then until which time."""
        waiting: list[bytes] = []
        waiting_bytes = 0
        kind: tuple[str, bool] | None = None  # of the waiting messages: their producer, and whether they are new
        for producer, sequence, payload, after_gap in self._messages(session.spans):
            if after_gap:
                yield from self._decoded(waiting, kind)
                waiting, waiting_bytes = [], 0
                self.has_gap.add(session.producer)
            if not payload:
                break
            is_new = sequence >= self._next_new.get(producer, 0)
            is_full = len(waiting) >= MOST_MESSAGES or waiting_bytes + len(payload) > LARGEST_BLOCK_BYTES
            if (producer, is_new) != kind or is_full:
                yield from self._decoded(waiting, kind)
                waiting, waiting_bytes, kind = [], 0, (producer, is_new)
            if is_new:
                self._next_new[producer] = sequence + 1
            waiting.append(payload)
            waiting_bytes += len(payload)
            is_last_known = (producer, sequence) == (session.spans[-1].producer, session.spans[-1].last_known)
            until_t_ns = session.timer_outputs.get((producer, sequence))
            if until_t_ns is not None:
                *blocks, (last, _) = self._decoded(waiting, kind)
                yield from blocks
                yield last, until_t_ns
                waiting, waiting_bytes = [], 0
            if is_last_known:
                yield from self._decoded(waiting, kind)
                waiting, waiting_bytes = [], 0
                self.is_past_known.add(session.producer)
        yield from self._decoded(waiting, kind)

    def _decoded(self, payloads: Sequence[bytes], kind: tuple[str, bool] | None) -> Iterator[tuple[Raw, None]]:
        for block in decode_together(Raw, payloads):
            if self._first_t_ns is None and len(block.host_receive_t_ns):
                self._first_t_ns = int(block.host_receive_t_ns[0])
                self.samples_in_message = len(block.host_receive_t_ns) / len(payloads)
            wanted = self._in_stretch(block)
            if kind and kind[1]:
                self._observe(wanted)
            if len(wanted.host_receive_t_ns):
                yield wanted, None

    def _in_stretch(self, block: Raw) -> Raw:
        if self._stretch_s == (0.0, math.inf) or not len(block.host_receive_t_ns):
            return block
        assert self._first_t_ns is not None
        since_s = (block.host_receive_t_ns - self._first_t_ns) / NS_PER_S
        inside = np.flatnonzero((since_s >= self._stretch_s[0]) & (since_s < self._stretch_s[1]))
        return cut(block, int(inside[0]), int(inside[-1]) + 1) if len(inside) else cut(block, 0, 0)

    def _messages(self, spans: Sequence[Span]) -> Iterator[tuple[str, int, bytes, bool]]:
        """Producer, sequence number and bytes of the raw messages of spans, each once, and whether messages before it
        are missing. The last has no bytes and stands for the end.

        Spans only go forward. An open span continues with whichever producer follows. Gaps are counted.
        """
        after_gap = False
        next_sequence: dict[str, int] = {}
        number, has_begun = 0, not spans[0].producer
        due: dict[str, int] = {spans[0].producer: spans[0].first} if spans[0].producer else {}
        for envelope in self._read():
            header = envelope.header
            producer, sequence = header.producer, header.sequence
            if sequence < next_sequence.get(producer, 0):
                continue  # this part of the recording overlaps the one before
            next_sequence[producer] = sequence + 1
            while not _contains(spans[number], producer, sequence) and _is_later(spans, number, producer, sequence):
                after_gap |= self._count_gap(spans[number].producer, due, spans[number].last_known + 1)
                number += 1
                has_begun = False
                due[spans[number].producer] = spans[number].first
            span = spans[number]
            if _contains(span, producer, sequence):
                has_begun = True
            elif producer == span.producer or not has_begun or span.last is not None:
                continue
            else:  # of a producer that was killed, the recorder may lack the last messages, which this session consumed
                after_gap |= self._count_gap(span.producer, due, span.last_known + 1)
            after_gap |= self._count_gap(producer, due, sequence)
            due[producer] = sequence + 1
            yield producer, sequence, envelope.payload, after_gap
            after_gap = False
        for span in spans[number:]:
            if span.producer:
                due[span.producer] = max(due.get(span.producer, 0), span.first)
                after_gap |= self._count_gap(span.producer, due, span.last_known + 1)
        yield "", 0, b"", after_gap

    def _count_gap(self, producer: str, due: dict[str, int], end: int) -> bool:
        """Count the producer's messages from the one that is due up to `end`, which is then due. Returns whether there
        are any."""
        first = due.get(producer, end)
        due[producer] = max(first, end)
        if end > first:
            self._gaps[producer, first] = max(self._gaps.get((producer, first), 0), end - first)
        return end > first


def _contains(span: Span, producer: str, sequence: int) -> bool:
    return producer == span.producer and span.first <= sequence and (span.last is None or sequence <= span.last)


def _is_later(spans: Sequence[Span], number: int, producer: str, sequence: int) -> bool:
    """Whether a message belongs to a later span, so that this one is over."""
    return any(span.producer == producer and sequence >= span.first for span in spans[number + 1 :])
