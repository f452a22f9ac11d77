"""Messages to protobuf bytes and back.

A packed field's bytes are the array's own little-endian bytes (enums and booleans: one byte a value while
they stay below 128), so a column is appended to the serialised scalars as key, length and bytes. What comes
out is standard protobuf that any reader decodes with `fan.proto`.
"""

from __future__ import annotations

from dataclasses import fields
from typing import Any, get_args

import numpy as np
from google.protobuf.message import DecodeError
from google.protobuf.message import Message as ProtoMessage

from schemas import fan_pb2
from schemas.messages import (
    MESSAGE_TYPES,
    Cause,
    Counter,
    FanState,
    Header,
    Input,
    Message,
    Output,
    Prediction,
    Severity,
    StageStatus,
    WhyNot,
    columns,
)

_LENGTH_DELIMITED = 2
_RECORDS = {"inputs": Input, "outputs": Output, "counters": Counter}
_ENUMS = {"severity": Severity, "status": StageStatus}
_ENUM_COLUMNS = {"why_not": max(WhyNot), "state": max(FanState)}
_OF_SOME_DEVICES = {"device_clock_us", "device_sequence"}  # the only columns of samples that may be empty
LARGEST_STEP_NS = 86_400_000_000_000  # a day
FURTHEST_T_NS = (1 << 62) - LARGEST_STEP_NS  # in the year 2116, and as far before 1970: differences fit into 64 bits
_FURTHEST = {"host_receive_t_ns": FURTHEST_T_NS, "t_ns": 1 << 62}  # the grid may go a little beyond what was received
_COLUMNS = {t: columns(t) for t in MESSAGE_TYPES}
_SCALARS = {
    t: tuple(f.name for f in fields(t) if "shape" not in f.metadata and f.name != "header") for t in MESSAGE_TYPES
}


class CodecError(ValueError):
    """Bytes that are not the message they should be."""


def proto_type(message_type: type[Message]) -> type[ProtoMessage]:
    """The generated protobuf class of a message type."""
    return getattr(fan_pb2, message_type.__name__)


def type_name(message_type: type[Message]) -> str:
    """Full protobuf name, for example `fantwin.Raw`: the encoding on the bus and the schema name in recordings."""
    return proto_type(message_type).DESCRIPTOR.full_name


def _varint(value: int) -> bytes:
    out = bytearray()
    while value > 0x7F:
        out.append((value & 0x7F) | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)


_KEYS = {
    t: {
        name: _varint(proto_type(t).DESCRIPTOR.fields_by_name[name].number << 3 | _LENGTH_DELIMITED)
        for name in _COLUMNS[t]
    }
    for t in MESSAGE_TYPES
}


def encode(message: Message) -> bytes:
    """Serialise a message.

    Raises:
        CodecError: a column's shape does not fit the message's samples and fans, or its times make no sense.
    """
    kind = type(message)
    _check_step(message)
    proto: Any = proto_type(kind)()
    proto.header.producer = message.header.producer
    proto.header.sequence = message.header.sequence
    proto.header.tray = message.header.tray
    if (cause := message.header.cause) is not None:
        proto.header.cause.topic = cause.topic
        proto.header.cause.producer = cause.producer
        proto.header.cause.sequence = cause.sequence
        proto.header.cause.taken = cause.taken
        proto.header.cause.by_time = cause.by_time
    for name in _SCALARS[kind]:
        value = getattr(message, name)
        if name in _RECORDS:
            for record in value:
                getattr(proto, name).add(**{f.name: getattr(record, f.name) for f in fields(record)})
        else:
            setattr(proto, name, value)
    parts = [proto.SerializeToString()]
    samples = _sample_count(message)
    for name, (shape, dtype) in _COLUMNS[kind].items():
        column = np.asarray(getattr(message, name), dtype=dtype.newbyteorder("<"))
        _check_column(message, name, column, shape, samples)
        if column.size == 0:
            continue
        data = column.tobytes()
        parts += (_KEYS[kind][name], _varint(len(data)), data)
    return b"".join(parts)


def decode(message_type: type[Message], data: bytes) -> Message:
    """Parse bytes into a message; columns come back read-only in their declared shape.

    Raises:
        CodecError: the bytes are not such a message.
    """
    proto: Any = proto_type(message_type)()
    try:
        proto.ParseFromString(data)
    except DecodeError as error:
        raise CodecError(f"{len(data)} bytes are not a {type_name(message_type)}: {error}") from error
    values: dict[str, Any] = {
        "header": _header(proto.header),
    }
    for name in _SCALARS[message_type]:
        value = getattr(proto, name)
        if name in _RECORDS:
            record = _RECORDS[name]
            value = tuple(record(**{f.name: getattr(item, f.name) for f in fields(record)}) for item in value)
        elif name in _ENUMS:
            value = _enum(name, value, message_type)
        values[name] = value
    fans = values.get("fans", 0)
    for name, (shape, dtype) in _COLUMNS[message_type].items():
        column = _column(getattr(proto, name), name, dtype, message_type)
        if shape == "samples x fans":
            if fans == 0 or column.size % fans:
                if column.size:
                    raise CodecError(f"{type_name(message_type)}.{name} has {column.size} values for {fans} fans")
                column = column.reshape(0, fans)
            else:
                column = column.reshape(-1, fans)
        column.setflags(write=False)
        values[name] = column
    message = message_type(**values)
    _check_step(message)
    samples = _sample_count(message)
    for name, (shape, _) in _COLUMNS[message_type].items():
        _check_column(message, name, values[name], shape, samples)
    return message


def _header(proto: Any) -> Header:
    cause = None
    if proto.HasField("cause"):
        made = proto.cause
        cause = Cause(made.topic, made.producer, made.sequence, made.taken, made.by_time)
    return Header(proto.producer, proto.sequence, proto.tray, cause)


def _column(field: Any, name: str, dtype: np.dtype[Any], message_type: type[Message]) -> np.ndarray[Any, Any]:
    if name not in _ENUM_COLUMNS:
        return np.asarray(field, dtype=dtype)
    values = np.asarray(field, dtype=np.int64)
    if values.size and not (values.min() >= 0 and values.max() <= _ENUM_COLUMNS[name]):
        raise CodecError(f"{type_name(message_type)}.{name} holds values that are not known here: a newer producer?")
    return values.astype(dtype)


def _enum(name: str, value: int, message_type: type[Message]) -> Any:
    try:
        return _ENUMS[name](value)
    except ValueError as error:
        raise CodecError(f"{type_name(message_type)}.{name} = {value} is not known here: a newer producer?") from error


def _sample_count(message: Message) -> int:
    """Samples in a message, by its time column; -1 for messages without one."""
    for name, (shape, _) in _COLUMNS[type(message)].items():
        if shape == "samples":
            return len(getattr(message, name))
    return -1


def _check_step(message: Message) -> None:
    step_ns = getattr(message, "step_ns", 1)
    if not 0 < step_ns <= LARGEST_STEP_NS:
        raise CodecError(f"{type_name(type(message))}.step_ns = {step_ns}: a step is 1 ns to a day")


def _check_column(message: Message, name: str, column: np.ndarray[Any, Any], shape: str, samples: int) -> None:
    if column.size == 0 and _may_be_empty(message, name, shape, samples):
        return
    if name in _FURTHEST and not (-_FURTHEST[name] < column.min() and column.max() < _FURTHEST[name]):
        raise CodecError(f"{type_name(type(message))}.{name} has times that are no ns since 1970: beyond the year 2116")
    fans = getattr(message, "fans", column.size)
    expected = {"samples": (samples,), "samples x fans": (samples, fans), "fans": (fans,)}[shape]
    if column.shape != expected:
        raise CodecError(f"{type_name(type(message))}.{name} has shape {column.shape}, not {shape} = {expected}")


def _may_be_empty(message: Message, name: str, shape: str, samples: int) -> bool:
    if shape == "fans":
        return samples <= 0 or not isinstance(message, Prediction)  # without sigma nothing can be judged
    return samples == 0 or name in _OF_SOME_DEVICES


assert set(get_args(Message)) == set(MESSAGE_TYPES)
