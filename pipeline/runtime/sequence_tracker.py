"""Puts arriving messages in sequence: missing messages are requested, duplicates dropped, and messages that remain
missing counted."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import TypeAlias

from schemas.envelope import Envelope
from schemas.messages import Health, Input
from schemas.streams import StreamId, StreamState, output_streams
from schemas.topics import topic_of

MAX_NAMED_PRODUCERS = 64
"""of one key, in health: the latest are listed by name. Every `fantwin alarms ack` is a producer of its own."""
Recover: TypeAlias = Callable[[str, str, int, int], Iterable[Envelope]]


class SequenceTracker:
    """Tracks every stream a stage reads.

    `recover(key, producer, first, last)` asks a producer for messages that it still keeps. Without it, gaps are only
    counted.

    The first message seen of a stream need not be its first. Earlier messages that the producer still keeps are asked
    for; those it no longer keeps are history, not a loss. From then on every gap is either recovered or counted.
    """

    def __init__(self, recover: Recover | None) -> None:
        self._recover = recover
        self._streams: dict[str, dict[str, StreamState]] = {}
        """by key, then by producer; the producer heard last is at the end"""

    def accept(self, envelope: Envelope) -> Iterator[Envelope]:
        """The messages to process now that this one has arrived: recovered ones first; none if it is a duplicate."""
        header = envelope.message.header
        state = self._state(envelope.key, header.producer)
        if not state.is_duplicate(header.sequence):
            yield from self._fill((envelope.key, header.producer), state, header.sequence)
        if state.accept(header.sequence):
            yield envelope

    def reconcile(self, health: Health, keys: Iterable[str]) -> Iterator[Envelope]:
        """The recovered messages on `keys` that a producer reports as published and that never arrived. On a topic with
        few messages no next message would show the gap."""
        wanted = set(keys)
        for stream, published in output_streams(health).items():
            if stream[0] in wanted:
                yield from self._fill(stream, self._state(*stream), published)

    def inputs(self) -> tuple[Input, ...]:
        """The counts for health. The oldest producers of a key with many are summed up under an empty name."""
        found: list[Input] = []
        for key, by_producer in self._streams.items():
            states = [(producer, state) for producer, state in by_producer.items() if state.next_sequence is not None]
            others, named = states[:-MAX_NAMED_PRODUCERS], states[-MAX_NAMED_PRODUCERS:]
            found += [state.as_input((key, producer)) for producer, state in named]
            if others:
                total = StreamState()
                for _, state in others:
                    total.add(state)
                found.append(total.as_input((key, "")))
        return tuple(found)

    def _state(self, key: str, producer: str) -> StreamState:
        by_producer = self._streams.setdefault(key, {})
        state = by_producer[producer] = by_producer.pop(producer, None) or StreamState()
        return state

    def _fill(self, stream: StreamId, state: StreamState, until: int) -> Iterator[Envelope]:
        """Recover what is due before sequence number `until`, and count the rest as missing."""
        (key, producer), due = stream, state.next_sequence
        first = max(0, until - topic_of(key).history) if due is None else due
        if first < until and self._recover:
            recovered = self._recover(key, producer, first, until - 1)
            for envelope in sorted(recovered, key=lambda envelope: envelope.message.header.sequence):
                sequence = envelope.message.header.sequence
                if first <= sequence < until and not state.is_duplicate(sequence):
                    state.accept(sequence)
                    yield envelope
        state.skip_to(until)
