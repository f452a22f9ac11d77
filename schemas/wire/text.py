"""Frames in the text form: `S clock sequence command speed ... [V value ...] [I ...] [T ...]`, `C fan value`,
`P fan value`."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from fantwin.schemas.channels import CHANNELS
from fantwin.schemas.wire.frames import UINT32, CommandFrame, FaultKind, Frame, FrameError, Sample, SetPointFrame

LETTER = re.compile(rb"[SCP]")  # begins a line and occurs nowhere else, so that a reader can find the next line
_INTEGER = re.compile(rb"[0-9]{1,10}")
_NUMBER = re.compile(rb"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?|nan|[+-]?inf")
_NONE = b"-"


def _text_number(value: float) -> str:
    return "-" if math.isnan(value) else str(np.float32(value))


def _text_group(values: Sequence[float]) -> list[str]:
    """One value for all fans, or one for each."""
    fields = [_text_number(value) for value in values]
    return fields[:1] if fields.count(fields[0]) == len(fields) else fields


def encode_text(frame: Sample | CommandFrame | SetPointFrame) -> bytes:
    """The lines of a valid frame."""
    if isinstance(frame, Sample):
        head = ["-" if field is None else str(field) for field in (frame.clock_us, frame.sequence)]
        pairs = [_text_number(v) for pair in zip(frame.command, frame.speed, strict=True) for v in pair]
        groups = [
            field
            for column in CHANNELS
            if (values := frame.measured.get(column.name))
            for field in (column.letter, *_text_group(values))
        ]
        return (" ".join(["S", *head, *pairs, *groups]) + "\n").encode()
    letter, values = ("C", frame.command) if isinstance(frame, CommandFrame) else ("P", frame.set_point)
    lines = [f"{letter} {fan} {_text_number(value)}\n" for fan, value in enumerate(values) if not math.isnan(value)]
    return "".join(lines).encode()


def _integer(field: bytes) -> int:
    if not _INTEGER.fullmatch(field) or int(field) >= UINT32:
        raise FrameError(FaultKind.BAD_NUMBER, f"{field!r} is not a 32-bit integer")
    return int(field)


def _number(field: bytes) -> float:
    """A printed number; `-` and nan are NaN, Arduino's `ovf` is infinity."""
    if field == _NONE:
        return math.nan
    field = field.lower().replace(b"ovf", b"inf")
    if not _NUMBER.fullmatch(field):
        raise FrameError(FaultKind.BAD_NUMBER, f"{field!r} is not a number")
    return float(field)


def _numbers(fields: Sequence[bytes]) -> tuple[float, ...]:
    """Fields as float32; a value too large becomes infinite."""
    with np.errstate(over="ignore"):
        return tuple(np.array([_number(field) for field in fields], np.float32).tolist())


_COLUMN_OF_LETTER = {column.letter.encode(): column.name for column in CHANNELS}


def _split_groups(fields: list[bytes]) -> tuple[list[bytes], dict[str, tuple[float, ...]]]:
    """The fields of a sample before its groups, and the columns of these, one value for each of its fans."""
    starts = [place for place, field in enumerate(fields) if field in _COLUMN_OF_LETTER]
    if not starts:
        return fields, {}
    columns: dict[str, tuple[float, ...]] = {}
    fans = (starts[0] - 2) // 2
    for start, end in pairwise((*starts, len(fields))):
        letter, values = fields[start], _numbers(fields[start + 1 : end])
        name = _COLUMN_OF_LETTER[letter]
        if name in columns:
            raise FrameError(FaultKind.GARBAGE, f"two groups {letter.decode()} in a line")
        if len(values) not in (1, fans):
            detail = f"{len(values)} values after {letter.decode()}; one is needed, or one for each of {fans} fans"
            raise FrameError(FaultKind.TRUNCATED, detail)
        columns[name] = values if len(values) == fans else values * fans
    return fields[: starts[0]], columns


def decode_text(line: bytes, fans: int) -> Frame:
    """The frame of a line that begins with a letter of the protocol.

    Raises:
        FrameError: it is none.
    """
    fields = line[1:].split()
    if not line[1:2].isspace():
        raise FrameError(FaultKind.GARBAGE, f"{line[:24]!r} is not a line of this protocol")
    if line[:1] == b"S":
        fields, columns = _split_groups(fields)
        if len(fields) < 4 or len(fields) % 2:
            raise FrameError(FaultKind.TRUNCATED, f"{len(fields)} fields; S needs clock, sequence and two per fan")
        clock_us, sequence = (None if field == _NONE else _integer(field) for field in fields[:2])
        values = _numbers(fields[2:])
        return Sample(clock_us, sequence, values[0::2], values[1::2], columns)
    if len(fields) != 2:
        raise FrameError(FaultKind.TRUNCATED, f"{len(fields)} fields; {line[:1].decode()} needs fan and value")
    fan, (value,) = _integer(fields[0]), _numbers(fields[1:])
    if fan >= fans:
        raise FrameError(FaultKind.WRONG_FAN_COUNT, f"fan {fan}, this tray has {fans}, counted from 0")
    values = tuple(value if i == fan else math.nan for i in range(fans))
    return CommandFrame(values) if line[:1] == b"C" else SetPointFrame(values)
