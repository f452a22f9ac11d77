"""A message with what is known of its way: the key it came on, its bytes, and when it was received."""

from __future__ import annotations

from dataclasses import dataclass

from schemas.messages import Message


@dataclass(frozen=True, slots=True)
class Envelope:
    """One message as it came off the bus or out of a recording.

    `topic` is the name of its topic; `received_t_ns` is host time, ns since the epoch; `payload` is the protobuf
    bytes of
    `message`.
    """

    key: str
    topic: str
    payload: bytes
    received_t_ns: int
    message: Message
