"""The header of every message: who sent it, and what it was made of."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class InputPosition:
    """How far a stage had read its main input for one tray when it made a message.

    Attributes:
        topic, producer, sequence: the input message consumed last.
        consumed_count: all input messages consumed so far, that one included.
        contiguous_from: no sequence number is missing from this one up to `sequence`.
        from_timer: the message was made later, by a timer or at the end of the stage, not on consuming the input.
    """

    topic: str
    producer: str
    sequence: int
    consumed_count: int
    contiguous_from: int
    from_timer: bool = False

    @classmethod
    def after(cls, before: InputPosition | None, topic: str, header: Header) -> InputPosition:
        """The position after one more message, the one with this header."""
        follows = before is not None and (before.producer, before.sequence + 1) == (header.producer, header.sequence)
        return cls(
            topic=topic,
            producer=header.producer,
            sequence=header.sequence,
            consumed_count=before.consumed_count + 1 if before else 1,
            contiguous_from=before.contiguous_from if before and follows else header.sequence,
        )


@dataclass(frozen=True, slots=True)
class Header:
    """Producer and sequence number of a message, its tray, and the input it was made from."""

    producer: str = ""
    sequence: int = 0
    tray: str = ""
    input_position: InputPosition | None = None
