"""Packets of a producer by their sequence numbers, for tests of what counts losses."""

from __future__ import annotations

from collections.abc import Iterable

from fantwin.schemas.envelope import Envelope
from fantwin.schemas.health import Health, Output
from fantwin.schemas.topics import tray_key
from tests.support import made_messages

KEY = tray_key("site", "tray", "alarm")
PRODUCER = "scorer-all-p"


def packet(sequence: int, producer: str = PRODUCER) -> Envelope:
    return Envelope(KEY, "alarm", b"", 0, made_messages.alarm(tray="tray", producer=producer, sequence=sequence))


def sequences(packets: Iterable[Envelope]) -> list[int]:
    return [p.message.header.sequence for p in packets]


def health(published: int, producer: str = PRODUCER) -> Health:
    return made_messages.health("s", producer=producer, outputs=(Output(key=KEY, published=published),))
