"""The serial wire protocol in both directions: frames to bytes and back, without any input or output.

A device sends samples; the host sends commands and set-points. There are two equivalent forms: `binary` (COBS, CRC-32)
and `text` (lines that any sketch can print). Numbers are float32 in both, so that decoding inverts encoding exactly for
float32 values. Reference: docs/reference/wire-protocol.md.
"""

from __future__ import annotations

import math
import re
import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from itertools import pairwise
from typing import Literal, TypeAlias

import numpy as np
from cobs import cobs

from schemas.auxiliary import AUXILIARY

Protocol: TypeAlias = Literal["binary", "text"]
End: TypeAlias = Literal["host", "device"]
DELIMITERS: dict[Protocol, bytes] = {"binary": b"\0", "text": b"\n"}
"""between frames; one more is no frame and no fault"""

VERSION = 1
MAX_FANS = 64
MAX_FRAME_BYTES = 5120  # of both forms, that of 64 fans with all columns in text; bounds the memory of a decoder
UINT32 = 1 << 32


@dataclass(frozen=True, slots=True)
class Sample:
    """One sample of a device.

    Attributes:
        clock_us, sequence: wrap at 2^32; None if a text device has none.
        command: one value per fan, in the tray's command unit.
        speed: one value per fan, in the tray's speed unit; NaN without a tacho reading.
        supply_voltage_v, current_a, temperature_c: one value per fan, NaN if unknown; empty if not measured.
    """

    clock_us: int | None
    sequence: int | None
    command: tuple[float, ...]
    speed: tuple[float, ...]
    supply_voltage_v: tuple[float, ...] = ()
    current_a: tuple[float, ...] = ()
    temperature_c: tuple[float, ...] = ()

    @property
    def auxiliary(self) -> list[tuple[float, ...]]:
        """The columns beside command and speed, in the order of `AUXILIARY`."""
        return [getattr(self, column.name) for column in AUXILIARY]


@dataclass(frozen=True, slots=True)
class CommandFrame:
    """Commands, one per fan, in the tray's command unit; NaN leaves a fan unchanged."""

    command: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class SetPointFrame:
    """Speed set-points, one per fan, in the tray's speed unit, for a device with its own loop; NaN: unchanged."""

    set_point: tuple[float, ...]


class FaultKind(Enum):
    """Why a piece of the stream is not a frame."""

    RESYNC = "resync"  # the rest of a frame that began before listening started: harmless
    GARBAGE = "garbage"  # does not look like a frame
    TRUNCATED = "truncated"  # begins like a frame, but has the wrong length
    OVERSIZED = "oversized"  # longer than any frame
    WRONG_CRC = "wrong_crc"
    WRONG_VERSION = "wrong_version"
    WRONG_TYPE = "wrong_type"  # unknown, or not for this end of the line
    WRONG_FAN_COUNT = "wrong_fan_count"
    BAD_NUMBER = "bad_number"  # a field of a text line is not a number, or is out of range
    BAD_COMMAND = "bad_command"  # a sample's command is NaN or infinite


@dataclass(frozen=True, slots=True)
class Fault:
    """A piece of the stream that is not a frame, and why."""

    kind: FaultKind
    detail: str


Frame: TypeAlias = Sample | CommandFrame | SetPointFrame


class _FrameError(Exception):
    def __init__(self, kind: FaultKind, detail: str) -> None:
        super().__init__(kind, detail)
        self.fault = Fault(kind, detail)


# ---- binary: 0x00 COBS(version, type, [clock, sequence,] fans, [columns,] float32 ..., CRC-32) 0x00, little-endian

_HEAD = struct.Struct("<BB")  # version, type
_CLOCK_SEQUENCE = struct.Struct("<II")
_CRC = struct.Struct("<I")
_SAMPLE, _COMMAND, _SET_POINT, _SAMPLE_WITH_COLUMNS = 1, 2, 3, 4
_SAMPLES = (_SAMPLE, _SAMPLE_WITH_COLUMNS)
_TYPES = (_SAMPLE, _COMMAND, _SET_POINT, _SAMPLE_WITH_COLUMNS)
_SHORTEST = _HEAD.size + 1 + _CRC.size


def _float32_bytes(values: Sequence[float]) -> bytes:
    return np.asarray(values, dtype="<f4").tobytes()


def _encode_binary(frame: Frame) -> bytes:
    if isinstance(frame, Sample):
        present = [column for column in frame.auxiliary if column]
        rows = zip(frame.command, frame.speed, *present, strict=True)
        head = _HEAD.pack(VERSION, _SAMPLE_WITH_COLUMNS if present else _SAMPLE)
        payload = head + _CLOCK_SEQUENCE.pack(frame.clock_us, frame.sequence) + bytes([len(frame.command)])
        if present:
            payload += bytes([sum(1 << bit for bit, column in enumerate(frame.auxiliary) if column)])
        payload += _float32_bytes([value for row in rows for value in row])
    else:
        is_command = isinstance(frame, CommandFrame)
        values = frame.command if is_command else frame.set_point
        payload = _HEAD.pack(VERSION, _COMMAND if is_command else _SET_POINT)
        payload += bytes([len(values)]) + _float32_bytes(values)
    # A delimiter on both sides: noise on an idle line then ends before the frame and cannot spoil it.
    return b"\0" + cobs.encode(payload + _CRC.pack(zlib.crc32(payload))) + b"\0"


@dataclass(frozen=True, slots=True)
class _Layout:
    """Where the values of a payload are: `per_fan` of them for each of `fans`, from byte `at` on, and which columns."""

    at: int
    fans: int
    per_fan: int
    columns: int


def _layout(payload: bytes) -> _Layout:
    """The layout that the head of a payload of a known type announces.

    Raises:
        IndexError: it ends before.
    """
    frame_type = payload[1]
    count_at = _HEAD.size + (_CLOCK_SEQUENCE.size if frame_type in _SAMPLES else 0)
    fans = payload[count_at]
    if frame_type != _SAMPLE_WITH_COLUMNS:
        return _Layout(count_at + 1, fans, 2 if frame_type == _SAMPLE else 1, 0)
    columns = payload[count_at + 1]
    return _Layout(count_at + 2, fans, 2 + columns.bit_count(), columns)


def _fits_its_length(payload: bytes) -> bool:
    """Whether the length of a payload of a known type fits its fan count and columns."""
    try:
        layout = _layout(payload)
    except IndexError:
        return False
    return len(payload) == layout.at + 4 * layout.per_fan * layout.fans


def _decode_binary(piece: bytes) -> Frame:
    try:
        data = cobs.decode(piece)
    except cobs.DecodeError as error:
        raise _FrameError(FaultKind.TRUNCATED, f"{len(piece)} bytes end within a COBS block") from error
    if len(data) < _SHORTEST:
        raise _FrameError(FaultKind.TRUNCATED, f"{len(data)} bytes, the shortest frame has {_SHORTEST}")
    payload, (crc,) = data[: -_CRC.size], _CRC.unpack(data[-_CRC.size :])
    version, frame_type = _HEAD.unpack_from(payload)
    known = version == VERSION and frame_type in _TYPES
    if crc != zlib.crc32(payload):
        if not known:
            raise _FrameError(FaultKind.GARBAGE, f"{len(data)} bytes that are not a frame")
        if not _fits_its_length(payload):
            raise _FrameError(FaultKind.TRUNCATED, f"{len(data)} bytes do not fit the fan count of the frame")
        raise _FrameError(FaultKind.WRONG_CRC, f"CRC-32 {crc:08x} does not match the frame")
    if version != VERSION:
        raise _FrameError(FaultKind.WRONG_VERSION, f"version {version}, this side has {VERSION}")
    if not known:
        raise _FrameError(FaultKind.WRONG_TYPE, f"unknown frame type {frame_type}")
    if not _fits_its_length(payload):
        raise _FrameError(FaultKind.TRUNCATED, f"{len(data)} bytes do not fit the fan count of the frame")
    layout = _layout(payload)
    values = struct.unpack_from(f"<{layout.per_fan * layout.fans}f", payload, layout.at)
    if frame_type == _COMMAND:
        return CommandFrame(values)
    if frame_type == _SET_POINT:
        return SetPointFrame(values)
    clock_us, sequence = _CLOCK_SEQUENCE.unpack_from(payload, _HEAD.size)
    if frame_type == _SAMPLE:
        return Sample(clock_us, sequence, values[0::2], values[1::2])
    if layout.columns >> len(AUXILIARY):
        raise _FrameError(FaultKind.WRONG_TYPE, f"unknown columns, bits {layout.columns:#x}")
    present = [column.name for bit, column in enumerate(AUXILIARY) if layout.columns >> bit & 1]
    columns = {name: values[2 + place :: layout.per_fan] for place, name in enumerate(present)}
    return Sample(clock_us, sequence, values[0 :: layout.per_fan], values[1 :: layout.per_fan], **columns)


# ---- text: `S clock sequence command speed ... [V value ...] [I ...] [T ...]`, `C fan value`, `P fan value`, `# text`

_LETTER = re.compile(rb"[SCP]")  # begins a line and occurs nowhere else, so that a reader can find the next line
_INTEGER = re.compile(rb"[0-9]{1,10}")
_NUMBER = re.compile(rb"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?|nan|[+-]?inf")
_NONE = b"-"


def _text_number(value: float) -> str:
    return "-" if math.isnan(value) else str(np.float32(value))


def _text_group(values: Sequence[float]) -> list[str]:
    """One value for all fans, or one for each."""
    fields = [_text_number(value) for value in values]
    return fields[:1] if fields.count(fields[0]) == len(fields) else fields


def _encode_text(frame: Frame) -> bytes:
    if isinstance(frame, Sample):
        head = ["-" if field is None else str(field) for field in (frame.clock_us, frame.sequence)]
        pairs = [_text_number(v) for pair in zip(frame.command, frame.speed, strict=True) for v in pair]
        groups = [
            field
            for column, values in zip(AUXILIARY, frame.auxiliary, strict=True)
            if values
            for field in (column.letter, *_text_group(values))
        ]
        return (" ".join(["S", *head, *pairs, *groups]) + "\n").encode()
    letter, values = ("C", frame.command) if isinstance(frame, CommandFrame) else ("P", frame.set_point)
    lines = [f"{letter} {fan} {_text_number(value)}\n" for fan, value in enumerate(values) if not math.isnan(value)]
    return "".join(lines).encode()


def _integer(field: bytes) -> int:
    if not _INTEGER.fullmatch(field) or int(field) >= UINT32:
        raise _FrameError(FaultKind.BAD_NUMBER, f"{field!r} is not a 32-bit integer")
    return int(field)


def _number(field: bytes) -> float:
    """A printed number; `-` and nan are NaN, Arduino's `ovf` is infinity."""
    if field == _NONE:
        return math.nan
    field = field.lower().replace(b"ovf", b"inf")
    if not _NUMBER.fullmatch(field):
        raise _FrameError(FaultKind.BAD_NUMBER, f"{field!r} is not a number")
    return float(field)


def _numbers(fields: Sequence[bytes]) -> tuple[float, ...]:
    """Fields as float32; a value too large becomes infinite."""
    with np.errstate(over="ignore"):
        return tuple(np.array([_number(field) for field in fields], np.float32).tolist())


_COLUMN_OF_LETTER = {column.letter.encode(): column.name for column in AUXILIARY}


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
            raise _FrameError(FaultKind.GARBAGE, f"two groups {letter.decode()} in a line")
        if len(values) not in (1, fans):
            detail = f"{len(values)} values after {letter.decode()}; one is needed, or one for each of {fans} fans"
            raise _FrameError(FaultKind.TRUNCATED, detail)
        columns[name] = values if len(values) == fans else values * fans
    return fields[: starts[0]], columns


def _decode_text(line: bytes, fans: int) -> Frame:
    fields = line[1:].split()
    if not line[1:2].isspace():
        raise _FrameError(FaultKind.GARBAGE, f"{line[:24]!r} is not a line of this protocol")
    if line[:1] == b"S":
        fields, columns = _split_groups(fields)
        if len(fields) < 4 or len(fields) % 2:
            raise _FrameError(FaultKind.TRUNCATED, f"{len(fields)} fields; S needs clock, sequence and two per fan")
        clock_us, sequence = (None if field == _NONE else _integer(field) for field in fields[:2])
        values = _numbers(fields[2:])
        return Sample(clock_us, sequence, values[0::2], values[1::2], **columns)
    if len(fields) != 2:
        raise _FrameError(FaultKind.TRUNCATED, f"{len(fields)} fields; {line[:1].decode()} needs fan and value")
    fan, (value,) = _integer(fields[0]), _numbers(fields[1:])
    if fan >= fans:
        raise _FrameError(FaultKind.WRONG_FAN_COUNT, f"fan {fan}, this tray has {fans}, counted from 0")
    values = tuple(value if i == fan else math.nan for i in range(fans))
    return CommandFrame(values) if line[:1] == b"C" else SetPointFrame(values)


# ---- both


def encode(protocol: Protocol, frame: Frame) -> bytes:
    """Bytes of a frame with delimiters; `Decoder` turns them into the same frame in float32.

    In text, a command or set-point frame is one line for each fan that is not NaN, so possibly none.

    Raises:
        ValueError: no fans or more than 64, columns of different length, a clock or sequence outside 32 bits, or
            a binary sample without one of them.
    """
    fans = len(frame.set_point if isinstance(frame, SetPointFrame) else frame.command)
    if not 1 <= fans <= MAX_FANS:
        raise ValueError(f"{fans} fans; a frame carries 1 to {MAX_FANS}")
    if isinstance(frame, Sample):
        if any(len(column) not in (0, fans) for column in frame.auxiliary):
            raise ValueError(f"a column beside command and speed does not have {fans} values, one for each fan")
        for name, count in (("clock_us", frame.clock_us), ("sequence", frame.sequence)):
            if count is None and protocol == "binary":
                raise ValueError(f"{name} is missing; only a text sample may omit it")
            if count is not None and not 0 <= count < UINT32:
                raise ValueError(f"{name} = {count} does not fit 32 bits")
    return _encode_binary(frame) if protocol == "binary" else _encode_text(frame)


class Decoder:
    """Incremental parser for one end of a line: takes bytes as they arrive, gives frames and faults in order.

    It never raises and holds at most `MAX_FRAME_BYTES + 1` bytes between calls. The result does not depend on how the
    bytes are split into calls.
    """

    def __init__(self, protocol: Protocol, fans: int, end: End = "host") -> None:
        """Every frame must have `fans` fans. The end `host` accepts samples, `device` commands and set-points."""
        self._text = protocol == "text"
        self._delimiter = DELIMITERS[protocol]
        self._fans = fans
        self._accepts = (Sample,) if end == "host" else (CommandFrame, SetPointFrame)
        self.reset()

    def reset(self) -> None:
        """Drop a partial frame after an interruption; the line may continue in the middle of another frame."""
        self._pending = b""
        self._joining = True

    def feed(self, data: bytes) -> list[Frame | Fault]:
        """The frames and faults that `data` completes."""
        *pieces, rest = (self._pending + data).split(self._delimiter)
        # Of a piece that is too long, keep the first byte (it may begin a comment) and the newest bytes (a frame may
        # begin there). Its length still shows that it is too long, however the stream is split.
        self._pending = rest if len(rest) <= MAX_FRAME_BYTES else rest[:1] + rest[-MAX_FRAME_BYTES:]
        found: list[Frame | Fault] = []
        for piece in pieces:
            found += self._decode_line(piece) if self._text else self._decode_piece(piece)
            self._joining = False
        return found

    def _decode_piece(self, piece: bytes) -> list[Frame | Fault]:
        if not piece:
            return []
        if len(piece) > MAX_FRAME_BYTES:
            return [self._fault(FaultKind.OVERSIZED, f"more than {MAX_FRAME_BYTES} bytes without an end")]
        try:
            return [self._checked(_decode_binary(piece))]
        except _FrameError as error:
            return [self._fault(error.fault.kind, error.fault.detail)]

    def _decode_line(self, line: bytes) -> list[Frame | Fault]:
        if line.startswith(b"#") or not line.strip():
            return []
        found: list[Frame | Fault] = []
        tail = line[-MAX_FRAME_BYTES:]
        starts = [match.start() for match in _LETTER.finditer(tail)]
        before = tail[: starts[-1]] if starts else tail
        if len(line) > MAX_FRAME_BYTES:
            found.append(self._fault(FaultKind.OVERSIZED, f"more than {MAX_FRAME_BYTES} bytes without an end"))
        elif before.strip():
            found.append(self._fault(FaultKind.GARBAGE, f"{before[:24]!r} is not a line of this protocol"))
        if starts:
            try:
                found.append(self._checked(_decode_text(tail[starts[-1] :], self._fans)))
            except _FrameError as error:
                found.append(self._fault(error.fault.kind, error.fault.detail))
        return found

    def _checked(self, frame: Frame) -> Frame:
        """The frame, if it is for this end and tray."""
        if not isinstance(frame, self._accepts):
            raise _FrameError(FaultKind.WRONG_TYPE, f"{type(frame).__name__} is not for this end of the line")
        fans = len(frame.set_point if isinstance(frame, SetPointFrame) else frame.command)
        if fans != self._fans:
            raise _FrameError(FaultKind.WRONG_FAN_COUNT, f"frame of {fans} fans, this tray has {self._fans}")
        if isinstance(frame, Sample) and not all(map(math.isfinite, frame.command)):
            raise _FrameError(FaultKind.BAD_COMMAND, "a sample's command is NaN or infinite")
        return frame

    def _fault(self, kind: FaultKind, detail: str) -> Fault:
        return Fault(FaultKind.RESYNC, detail) if self._joining else Fault(kind, detail)
