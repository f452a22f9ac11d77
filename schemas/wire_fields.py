"""The fields of a protobuf message as they lie in its bytes, for readers that need few of them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

VARINT, FIXED64, LENGTH_DELIMITED, FIXED32 = 0, 1, 2, 5
_FIXED_BYTES = {FIXED64: 8, FIXED32: 4}


class WireError(ValueError):
    """The bytes end within a field, or are no protobuf."""


@dataclass(frozen=True, slots=True)
class WireField:
    """One field: its key is at data[key:], its value is data[start:end]."""

    number: int
    wire_type: int
    key: int
    start: int
    end: int


def wire_fields(data: bytes) -> Iterator[WireField]:
    """The fields in their order. Raises WireError, when it comes to it."""
    place, size = 0, len(data)
    try:
        while place < size:
            first = place
            key, start = _varint(data, place)
            wire_type = key & 7
            if wire_type == LENGTH_DELIMITED:
                length, start = _varint(data, start)
                place = start + length
            elif wire_type == VARINT:
                _, place = _varint(data, start)
            else:
                place = start + _FIXED_BYTES[wire_type]
            if place > size:
                raise WireError(f"a field ends at byte {place} of {size}")
            yield WireField(key >> 3, wire_type, first, start, place)
    except (IndexError, KeyError) as error:
        raise WireError(f"no field at byte {place} of {size}") from error


def _varint(data: bytes, place: int) -> tuple[int, int]:
    """The number at a place, and the place after it."""
    byte = data[place]
    value, shift = byte & 0x7F, 7
    while byte > 0x7F:
        place += 1
        byte = data[place]
        value |= (byte & 0x7F) << shift
        shift += 7
    return value, place + 1
