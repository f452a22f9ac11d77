"""Messages to protobuf bytes and back.

A packed field's bytes are the array's own little-endian bytes (enums and booleans: one byte a value while
they stay below 128), so a column is appended to the serialised scalars as key, length and bytes. What comes
out is standard protobuf that any reader decodes with `fan.proto`.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any, get_args

import numpy as np
from google.protobuf.message import DecodeError
from google.protobuf.message import Message as ProtoMessage

from schemas import fan_pb2
from schemas.messages import (
    MESSAGE_TYPES,
    Action,
    Array,
    Counter,
    Diagnosis,
    FanState,
    Header,
    Input,
    InputPosition,
    InvalidReason,
    Message,
    Output,
    Prediction,
    Score,
    Severity,
    StageStatus,
    Statistic,
    Transition,
    columns,
)

_LENGTH_DELIMITED = 2
_RECORDS = {"inputs": Input, "outputs": Output, "counters": Counter, "causes": Diagnosis}
_ENUMS = {
    "severity": Severity,
    "status": StageStatus,
    "transition": Transition,
    "statistic": Statistic,
    "action": Action,
}
_ENUM_COLUMNS = {"invalid_reason": max(InvalidReason), "state": max(FanState), "statistic": max(Statistic)}
_OF_SOME_DEVICES = {"device_clock_us", "device_sequence"}  # the only columns of samples that may be empty
_ADDED_LATER: dict[type[Message], set[str]] = {
    Prediction: {"torque_balance_command", "torque_balance_sigma_command"},
    Score: {"torque_balance_command", "speed_baseline_rad_s", "balance_baseline_command", "score", "statistic"},
}
"""columns that older recordings do not have: they read as NaN, or 0"""
LARGEST_PERIOD_NS = 86_400_000_000_000  # a day
FURTHEST_T_NS = (1 << 62) - LARGEST_PERIOD_NS  # in the year 2116, and as far before 1970: differences fit into 64 bits
_FURTHEST = {"host_receive_t_ns": FURTHEST_T_NS, "t_ns": 1 << 62}  # the grid may go a little beyond what was received
_FEW = 48  # up to so many values a list is a quicker way into an array than the protobuf field itself
_SCALARS = {
    t: tuple(f.name for f in fields(t) if "shape" not in f.metadata and f.name != "header") for t in MESSAGE_TYPES
}


@dataclass(frozen=True, slots=True)
class _Column:
    """What is known of a column before any message is there."""

    name: str
    shape: str
    dtype: np.dtype[Any]
    key: bytes  # of its packed field
    limits: tuple[int, int] | None  # of its values, for times and enums


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


def _limits(name: str) -> tuple[int, int] | None:
    if name in _FURTHEST:
        return 1 - _FURTHEST[name], _FURTHEST[name] - 1
    return (0, _ENUM_COLUMNS[name]) if name in _ENUM_COLUMNS else None


def _columns(message_type: type[Message]) -> tuple[_Column, ...]:
    numbers = {f.name: f.number for f in proto_type(message_type).DESCRIPTOR.fields}
    return tuple(
        _Column(name, shape, dtype, _varint(numbers[name] << 3 | _LENGTH_DELIMITED), _limits(name))
        for name, (shape, dtype) in columns(message_type).items()
    )


_COLUMNS = {t: _columns(t) for t in MESSAGE_TYPES}


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
    if (position := message.header.input_position) is not None:
        proto.header.input_position.topic = position.topic
        proto.header.input_position.producer = position.producer
        proto.header.input_position.sequence = position.sequence
        proto.header.input_position.consumed_count = position.consumed_count
        proto.header.input_position.contiguous_from = position.contiguous_from
        proto.header.input_position.from_timer = position.from_timer
    for name in _SCALARS[kind]:
        value = getattr(message, name)
        if name in _RECORDS:
            for record in value:
                getattr(proto, name).add(**{f.name: getattr(record, f.name) for f in fields(record)})
        else:
            setattr(proto, name, value)
    parts = [proto.SerializeToString()]
    samples = _sample_count(message)
    for column in _COLUMNS[kind]:
        values = np.asarray(getattr(message, column.name), dtype=column.dtype.newbyteorder("<"))
        if values.size and column.name in _FURTHEST:
            _check_limits(kind, column, values)
        _check_shape(message, column, values, samples, getattr(message, "fans", values.size))
        if values.size == 0:
            continue
        data = values.tobytes()
        parts += (column.key, _varint(len(data)), data)
    return b"".join(parts)


def decode(message_type: type[Message], data: bytes) -> Message:
    """Parse bytes into a message; columns come back read-only in their declared shape.

    What was added to a message since it was recorded is NaN, or 0.

    Raises:
        CodecError: the bytes are not such a message.
    """
    try:
        proto: Any = proto_type(message_type).FromString(data)
    except DecodeError as error:
        raise CodecError(f"{len(data)} bytes are not a {type_name(message_type)}: {error}") from error
    values: dict[str, Any] = {"header": _header(proto.header)}
    for name in _SCALARS[message_type]:
        value = getattr(proto, name)
        if name in _RECORDS:
            record = _RECORDS[name]
            value = tuple(record(**{f.name: getattr(item, f.name) for f in fields(record)}) for item in value)
        elif name in _ENUMS:
            value = _enum(name, value, message_type)
        values[name] = value
    fans = values.get("fans", 0)
    for column in _COLUMNS[message_type]:
        array = _array(message_type, column, getattr(proto, column.name))
        if not array.size and column.name in _ADDED_LATER.get(message_type, ()) and len(values["t_ns"]):
            shape = (fans,) if column.shape == "fans" else (len(values["t_ns"]), fans)
            nothing = np.array(np.nan if column.dtype.kind == "f" else 0, column.dtype)
            array = np.broadcast_to(nothing, shape)  # takes no room: nothing has said yet that `fans` is true
        elif column.shape == "samples x fans":
            if array.size and (fans == 0 or array.size % fans):
                raise CodecError(f"{type_name(message_type)}.{column.name} has {array.size} values for {fans} fans")
            array = array.reshape(-1 if array.size else 0, fans)
        array.setflags(write=False)
        values[column.name] = array
    message = message_type(**values)
    _check_step(message)
    samples = _sample_count(message)
    for column in _COLUMNS[message_type]:
        array = values[column.name]
        _check_shape(message, column, array, samples, values.get("fans", array.size))
    return message


def _header(proto: Any) -> Header:
    position = None
    if proto.HasField("input_position"):
        of = proto.input_position
        position = InputPosition(
            of.topic, of.producer, of.sequence, of.consumed_count, of.contiguous_from, of.from_timer
        )
    return Header(proto.producer, proto.sequence, proto.tray, position)


def _array(message_type: type[Message], column: _Column, field: Any) -> Array:
    """The values of a packed field, (n,)."""
    if len(field) <= _FEW:
        values = field[:]
        if values:
            _check_limits(message_type, column, values)
        return np.array(values, column.dtype)
    values = np.asarray(field)
    _check_limits(message_type, column, values)
    return values.astype(column.dtype, copy=False)


def _enum(name: str, value: int, message_type: type[Message]) -> Any:
    try:
        return _ENUMS[name](value)
    except ValueError as error:
        raise CodecError(f"{type_name(message_type)}.{name} = {value} is not known here: a newer producer?") from error


def _sample_count(message: Message) -> int:
    """Samples in a message, by its time column; -1 for messages without one."""
    for column in _COLUMNS[type(message)]:
        if column.shape == "samples":
            return len(getattr(message, column.name))
    return -1


def _check_step(message: Message) -> None:
    period_ns = getattr(message, "period_ns", 1)
    if not 0 < period_ns <= LARGEST_PERIOD_NS:
        raise CodecError(f"{type_name(type(message))}.period_ns = {period_ns}: a step is 1 ns to a day")


def _check_limits(message_type: type[Message], column: _Column, values: list[int] | Array) -> None:
    """values: at least one."""
    if column.limits is None:
        return
    lowest, highest = column.limits
    if isinstance(values, list):
        fits = lowest <= min(values) and max(values) <= highest
    else:
        fits = lowest <= values.min() and values.max() <= highest
    if fits:
        return
    where = f"{type_name(message_type)}.{column.name}"
    if column.name in _FURTHEST:
        raise CodecError(f"{where} has times that are no ns since 1970: beyond the year 2116")
    raise CodecError(f"{where} holds values that are not known here: a newer producer?")


def _check_shape(message: Message, column: _Column, values: Array, samples: int, fans: int) -> None:
    if column.shape == "samples x fans":
        expected = (samples, fans)
    else:
        expected = (samples,) if column.shape == "samples" else (fans,)
    if values.shape != expected and not (values.size == 0 and _may_be_empty(message, column, samples)):
        where = f"{type_name(type(message))}.{column.name}"
        raise CodecError(f"{where} has shape {values.shape}, not {column.shape} = {expected}")


def _may_be_empty(message: Message, column: _Column, samples: int) -> bool:
    if column.shape == "fans":
        return samples <= 0 or not isinstance(message, Prediction)  # without sigma nothing can be judged
    return samples == 0 or column.name in _OF_SOME_DEVICES


assert set(get_args(Message)) == set(MESSAGE_TYPES)
