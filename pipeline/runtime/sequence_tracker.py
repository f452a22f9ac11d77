"""What comes in: every message once and in order, gaps asked for again, and what stays missing counted."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import TypeAlias

from schemas.envelope import Envelope
from schemas.messages import Health, Input
from schemas.topics import topic_of

MOST_PRODUCERS = 64  # of a key: so many are told of by name, the latest; every `fantwin alarms ack` is a new one
Recover: TypeAlias = Callable[[str, str, int, int], Iterable[Envelope]]


@dataclass(slots=True)
class _Line:
    """What is known of one producer on one key."""

    next_sequence: int | None = None
    received: int = 0
    missing: int = 0
    duplicated: int = 0

    def add(self, other: _Line) -> None:
        """Count another one's messages as well."""
        self.received += other.received
        self.missing += other.missing
        self.duplicated += other.duplicated


class SequenceTracker:
    """Puts the arrivals of all producers and keys in sequence.

    `recover(key, producer, first, last)` asks a producer for what it still keeps. Without it, what was missed is simply
    counted.

    The first message of an unknown producer need not be its first: what it still keeps from before is asked for,
    and what it no longer keeps is history, not a loss. From then on every gap is either recovered or counted.
    """

    def __init__(self, recover: Recover | None) -> None:
        self._recover = recover
        self._lines: dict[str, dict[str, _Line]] = {}
        """of each key, by producer; who spoke last is at the end"""

    def accept(self, packet: Envelope) -> Iterator[Envelope]:
        """The packets that are due now that this one has come: recovered ones first, nothing if it came before."""
        header = packet.message.header
        line = self._line(packet.key, header.producer)
        if line.next_sequence is not None and header.sequence < line.next_sequence:
            line.duplicated += 1
            return
        yield from self._fill(packet.key, header.producer, line, header.sequence)
        line.next_sequence = header.sequence + 1
        line.received += 1
        yield packet

    def reconcile(self, health: Health, keys: Iterable[str]) -> Iterator[Envelope]:
        """The packets on `keys` that a producer says it has published and that never came: on a rare topic no next
        message shows the gap."""
        wanted = set(keys)
        for output in health.outputs:
            if output.key in wanted:
                line = self._line(output.key, health.header.producer)
                yield from self._fill(output.key, health.header.producer, line, output.published)

    def inputs(self) -> tuple[Input, ...]:
        """The account, for health; of all but the latest producers of a key together, under an empty name."""
        told: list[tuple[str, str, _Line]] = []
        for key, lines in self._lines.items():
            of = list(lines.items())
            told += [(key, producer, line) for producer, line in of[-MOST_PRODUCERS:]]
            if len(of) > MOST_PRODUCERS:
                rest = _Line(next_sequence=0)
                for _, line in of[:-MOST_PRODUCERS]:
                    rest.add(line)
                told.append((key, "", rest))
        return tuple(
            Input(
                key=key,
                producer=producer,
                received=line.received,
                missing=line.missing,
                duplicated=line.duplicated,
                next_sequence=line.next_sequence or 0,
            )
            for key, producer, line in told
            if line.next_sequence is not None
        )

    def _line(self, key: str, producer: str) -> _Line:
        lines = self._lines.setdefault(key, {})
        line = lines[producer] = lines.pop(producer, None) or _Line()
        return line

    def _fill(self, key: str, producer: str, line: _Line, until: int) -> Iterator[Envelope]:
        """Bring a line up to sequence `until` (exclusive)."""
        known = line.next_sequence is not None
        first = line.next_sequence if line.next_sequence is not None else max(0, until - topic_of(key).history)
        if first >= until:
            line.next_sequence = first if line.next_sequence is None else line.next_sequence
            return
        line.next_sequence = until
        recovered = self._recover(key, producer, first, until - 1) if self._recover else ()
        for packet in sorted(recovered, key=lambda packet: packet.message.header.sequence):
            sequence = packet.message.header.sequence
            if first <= sequence < until:
                line.missing += sequence - first if known else 0
                line.received += 1
                first, known = sequence + 1, True
                yield packet
        line.missing += until - first if known else 0
