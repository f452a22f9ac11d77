"""Sequence accounting: how many messages of a stream were received, are missing, or came twice.

A stream is what one producer session publishes on one key. The producer numbers its messages from 0 without gaps, so
the numbers alone show a consumer what it missed. The first message that a consumer sees need not be number 0: earlier
messages are history, not a loss.

Stages (health), the launcher (losses of a site), recordings (the sequence ledger) and replay all count with this
module.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TypeAlias

from fantwin.schemas.header import InputPosition
from fantwin.schemas.health import Health, Input

LOSS_PREFIX = "lost_"
"""start of the names of counters that count losses"""
MOST_PUBLISHED = 1 << 53
"""no producer has ever published more messages on one key: 100,000 a second for 2,800 years"""

StreamId: TypeAlias = tuple[str, str]
"""(key, producer)"""


@dataclass(slots=True)
class StreamState:
    """What a consumer knows about one stream."""

    next_sequence: int | None = None
    """the next expected sequence number; None before anything is known of the stream"""
    received: int = 0
    missing: int = 0
    duplicated: int = 0
    missing_at_start: int = 0
    """those of the missing ones before the first that was received"""
    unsaved: int = 0
    """the last of the received ones, so many, that are lost if the consumer is killed now"""

    @property
    def first_sequence(self) -> int:
        """The number of the first message that was received or missing."""
        return (self.next_sequence or 0) - self.received - self.missing

    def is_duplicate(self, sequence: int) -> bool:
        """Whether this number is already counted, as received or as missing."""
        return self.next_sequence is not None and sequence < self.next_sequence

    def accept(self, sequence: int) -> bool:
        """Count an arrived message, and the gap before it as missing. False: a duplicate, counted as such."""
        if sequence != self.next_sequence:  # nearly all messages are in order; a scan counts hundreds of thousands
            if self.is_duplicate(sequence):
                self.duplicated += 1
                return False
            self.skip_to(sequence)
        self.received += 1
        self.next_sequence = sequence + 1
        return True

    def skip_to(self, sequence: int) -> int:
        """Count the messages before `sequence` that did not come as missing; returns how many those are. On a stream
        not known yet they are history: counting starts at `sequence`."""
        skipped = 0 if self.next_sequence is None else max(0, sequence - self.next_sequence)
        self.missing += skipped
        self.missing_at_start += 0 if self.received else skipped
        self.next_sequence = max(sequence, self.next_sequence or 0)
        return skipped

    def add(self, other: StreamState) -> None:
        """Add the counts of another stream; its sequence numbers are not comparable and stay out."""
        self.received += other.received
        self.missing += other.missing
        self.duplicated += other.duplicated

    def as_input(self, stream: StreamId, unsaved: int = 0) -> Input:
        """These counts as a health message carries them; unsaved: see `Input`."""
        return Input(
            key=stream[0],
            producer=stream[1],
            received=self.received,
            missing=self.missing,
            duplicated=self.duplicated,
            next_sequence=self.next_sequence or 0,
            missing_at_start=self.missing_at_start,
            unsaved=unsaved,
        )


def continues(before: InputPosition, position: InputPosition) -> bool:
    """Whether no input message is missing between two input positions of a stage."""
    return position.producer == before.producer and position.contiguous_from <= before.sequence + 1


def input_streams(health: Health) -> dict[StreamId, StreamState]:
    """The streams that a stage reads, as its health reports them."""
    return {
        (line.key, line.producer): StreamState(
            next_sequence=line.next_sequence,
            received=line.received,
            missing=line.missing,
            duplicated=line.duplicated,
            missing_at_start=line.missing_at_start,
            unsaved=line.unsaved,
        )
        for line in health.inputs
    }


def output_streams(health: Health) -> dict[StreamId, int]:
    """How many messages a stage has published on each of its streams, as its health reports them."""
    return {(output.key, health.header.producer): output.published for output in health.outputs}


def stage_losses(inputs: Iterable[Input], counters: Mapping[str, int], *, may_drop: bool) -> int:
    """What one stage has lost: its loss counters and, unless the stage may drop messages, the missing messages."""
    counted = sum(value for name, value in counters.items() if name.startswith(LOSS_PREFIX))
    return counted if may_drop else counted + sum(line.missing for line in inputs)
