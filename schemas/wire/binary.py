"""Frames in the binary form: 0x00 COBS(version, type, [clock, sequence,] fans, [columns,] float32 ..., CRC-32) 0x00,
little-endian."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from cobs import cobs

from fantwin.schemas.channels import CHANNELS
from fantwin.schemas.wire.frames import (
    DEVICE_COUNTERS,
    VERSION,
    CommandFrame,
    DeviceCounters,
    FaultKind,
    Frame,
    FrameError,
    Sample,
    SetPointFrame,
)

_HEAD = struct.Struct("<BB")  # version, type
_CLOCK_SEQUENCE = struct.Struct("<II")
_CRC = struct.Struct("<I")
_UPTIME_COUNT = struct.Struct("<IB")  # of device counters
_SAMPLE, _COMMAND, _SET_POINT, _SAMPLE_WITH_COLUMNS, _DEVICE_COUNTERS = 1, 2, 3, 4, 5
_SAMPLES = (_SAMPLE, _SAMPLE_WITH_COLUMNS)
_TYPES = (_SAMPLE, _COMMAND, _SET_POINT, _SAMPLE_WITH_COLUMNS, _DEVICE_COUNTERS)
_SHORTEST = _HEAD.size + 1 + _CRC.size


def _float32_bytes(values: Sequence[float]) -> bytes:
    return np.asarray(values, dtype="<f4").tobytes()


def encode_binary(frame: Frame) -> bytes:
    """The bytes of a valid frame, with delimiters on both sides."""
    if isinstance(frame, Sample):
        present = {bit: values for bit, each in enumerate(CHANNELS) if (values := frame.measured.get(each.name))}
        rows = zip(frame.command, frame.speed, *present.values(), strict=True)
        head = _HEAD.pack(VERSION, _SAMPLE_WITH_COLUMNS if present else _SAMPLE)
        payload = head + _CLOCK_SEQUENCE.pack(frame.clock_us, frame.sequence) + bytes([len(frame.command)])
        if present:
            payload += bytes([sum(1 << bit for bit in present)])
        payload += _float32_bytes([value for row in rows for value in row])
    elif isinstance(frame, DeviceCounters):
        payload = _HEAD.pack(VERSION, _DEVICE_COUNTERS) + _UPTIME_COUNT.pack(frame.uptime_s, len(frame.counts))
        payload += struct.pack(f"<{len(frame.counts)}H", *frame.counts)
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
    """Whether the length of a payload of a known type fits its fan count and columns, or its number of counters."""
    if payload[1] == _DEVICE_COUNTERS:
        values_at = _HEAD.size + _UPTIME_COUNT.size
        return len(payload) >= values_at and len(payload) == values_at + 2 * payload[values_at - 1]
    try:
        layout = _layout(payload)
    except IndexError:
        return False
    return len(payload) == layout.at + 4 * layout.per_fan * layout.fans


def decode_binary(piece: bytes) -> Frame:
    """The frame between two delimiters.

    Raises:
        FrameError: it is none.
    """
    try:
        data = cobs.decode(piece)
    except cobs.DecodeError as error:
        raise FrameError(FaultKind.TRUNCATED, f"{len(piece)} bytes end within a COBS block") from error
    if len(data) < _SHORTEST:
        raise FrameError(FaultKind.TRUNCATED, f"{len(data)} bytes, the shortest frame has {_SHORTEST}")
    payload, (crc,) = data[: -_CRC.size], _CRC.unpack(data[-_CRC.size :])
    version, frame_type = _HEAD.unpack_from(payload)
    known = version == VERSION and frame_type in _TYPES
    if crc != zlib.crc32(payload):
        if not known:
            raise FrameError(FaultKind.GARBAGE, f"{len(data)} bytes that are not a frame")
        if not _fits_its_length(payload):
            raise FrameError(FaultKind.TRUNCATED, f"{len(data)} bytes do not fit the counts of the frame")
        raise FrameError(FaultKind.WRONG_CRC, f"CRC-32 {crc:08x} does not match the frame")
    if version != VERSION:
        raise FrameError(FaultKind.WRONG_VERSION, f"version {version}, this side has {VERSION}")
    if not known:
        raise FrameError(FaultKind.UNKNOWN_TYPE, f"unknown frame type {frame_type}")
    if not _fits_its_length(payload):
        raise FrameError(FaultKind.TRUNCATED, f"{len(data)} bytes do not fit the counts of the frame")
    return _frame(frame_type, payload)


def _frame(frame_type: int, payload: bytes) -> Frame:
    """The frame of a payload of a known type and the right length.

    Raises:
        FrameError: it has unknown columns.
    """
    if frame_type == _DEVICE_COUNTERS:
        uptime_s, count = _UPTIME_COUNT.unpack_from(payload, _HEAD.size)
        counts = struct.unpack_from(f"<{count}H", payload, _HEAD.size + _UPTIME_COUNT.size)
        return DeviceCounters(uptime_s, counts[: len(DEVICE_COUNTERS)])
    layout = _layout(payload)
    values = struct.unpack_from(f"<{layout.per_fan * layout.fans}f", payload, layout.at)
    if frame_type == _COMMAND:
        return CommandFrame(values)
    if frame_type == _SET_POINT:
        return SetPointFrame(values)
    clock_us, sequence = _CLOCK_SEQUENCE.unpack_from(payload, _HEAD.size)
    if frame_type == _SAMPLE:
        return Sample(clock_us, sequence, values[0::2], values[1::2])
    if layout.columns >> len(CHANNELS):
        raise FrameError(FaultKind.WRONG_TYPE, f"unknown columns, bits {layout.columns:#x}")
    present = [column.name for bit, column in enumerate(CHANNELS) if layout.columns >> bit & 1]
    columns = {name: values[2 + place :: layout.per_fan] for place, name in enumerate(present)}
    return Sample(clock_us, sequence, values[0 :: layout.per_fan], values[1 :: layout.per_fan], columns)
