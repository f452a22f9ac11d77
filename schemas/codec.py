"""Messages to protobuf bytes and back.

A packed field's bytes are the array's own little-endian bytes (enums and booleans: one byte a value), so a column is
appended to the serialised scalars as key, length and bytes. The result is standard protobuf, which any reader decodes
with `fan.proto`.

`decode_together` is a shortcut for readers of hundreds of thousands of messages: it decodes many as one block.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, is_dataclass, replace
from functools import cache
from types import NoneType
from typing import Any, TypeVar, get_args, get_origin

import numpy as np
from google.protobuf.message import DecodeError
from google.protobuf.message import Message as ProtoMessage

from fantwin.schemas import fan_pb2
from fantwin.schemas.fields import Array, Column, OpenEnum, columns, other_fields, time_column
from fantwin.schemas.messages import LARGEST_PERIOD_NS, Message

_LENGTH_DELIMITED = 2
_HEADER_KEY = 1 << 3 | _LENGTH_DELIMITED  # of the field `header`, in every message
_SHORT = 48  # values; up to this length a list is a faster way into an array than the protobuf field itself

AnyMessage = TypeVar("AnyMessage", bound=Message)


class CodecError(ValueError):
    """Bytes that are not the message they should be, or a message that cannot be encoded."""


def proto_type(message_type: type[Message]) -> type[ProtoMessage]:
    """The generated protobuf class of a message type."""
    return getattr(fan_pb2, message_type.__name__)


def type_name(message_type: type[Message]) -> str:
    """Full protobuf name, for example `fantwin.Raw`: the encoding on the bus and the schema name in recordings."""
    return proto_type(message_type).DESCRIPTOR.full_name


@dataclass(frozen=True, slots=True)
class _Record:
    """How the fields of a dataclass that are not columns are copied to a protobuf message and back.

    Attributes:
        scalars: names of the plain fields, enums included.
        enums: those of them that are enums.
        nested: fields that hold another dataclass, and whether they may be None.
        repeated: fields that hold a tuple of dataclasses.
    """

    kind: type[Any]
    scalars: tuple[str, ...]
    enums: tuple[tuple[str, type[OpenEnum]], ...]
    nested: tuple[tuple[str, _Record, bool], ...]
    repeated: tuple[tuple[str, _Record], ...]

    def write(self, value: Any, proto: Any) -> None:
        """Copy the fields of `value` into `proto`."""
        for name in self.scalars:
            setattr(proto, name, getattr(value, name))
        for name, record, _ in self.nested:
            part = getattr(value, name)
            if part is not None:
                record.write(part, getattr(proto, name))
        for name, record in self.repeated:
            for item in getattr(value, name):
                record.write(item, getattr(proto, name).add())

    def read(self, proto: Any) -> dict[str, Any]:
        """The fields by name. Raises CodecError for an enum's value that no version can have."""
        values = {name: getattr(proto, name) for name in self.scalars}
        for name, enum in self.enums:
            try:
                values[name] = enum(values[name])
            except ValueError as error:
                raise CodecError(f"{proto.DESCRIPTOR.full_name}.{name}: {error}") from error
        for name, record, may_be_none in self.nested:
            absent = may_be_none and not proto.HasField(name)
            values[name] = None if absent else record.kind(**record.read(getattr(proto, name)))
        for name, record in self.repeated:
            values[name] = tuple([record.kind(**record.read(item)) for item in getattr(proto, name)])
        return values


@cache
def _record(kind: type[Any]) -> _Record:
    scalars: list[str] = []
    enums: list[tuple[str, type[OpenEnum]]] = []
    nested: list[tuple[str, _Record, bool]] = []
    repeated: list[tuple[str, _Record]] = []
    for name, annotation in other_fields(kind).items():
        arguments = get_args(annotation)
        inner = arguments[0] if arguments else annotation  # of `tuple[Inner, ...]` or `Inner | None`
        if get_origin(annotation) is tuple:
            repeated.append((name, _record(inner)))
        elif is_dataclass(inner):
            nested.append((name, _record(inner), NoneType in arguments))
        else:
            scalars.append(name)
            if issubclass(inner, OpenEnum):
                enums.append((name, inner))
    return _Record(kind, tuple(scalars), tuple(enums), tuple(nested), tuple(repeated))


@dataclass(frozen=True, slots=True)
class _PackedColumn:
    """A column with the dtype of its packed bytes, and the key of its field.

    Attributes:
        nothing: what an optional column is where the message has none; None: it is not optional.
    """

    name: str
    declared: Column
    dtype: np.dtype[Any]
    key: bytes
    nothing: Array | None


@dataclass(frozen=True, slots=True)
class _Layout:
    """What is known about a message type from its declaration alone."""

    name: str
    proto: type[ProtoMessage]
    record: _Record
    columns: tuple[_PackedColumn, ...]
    parts: dict[str, bytes]
    """the keys of the fields with nested messages that hold columns, by name"""
    time: str | None
    """name of the column of sample times; None for a message about one moment"""


@cache
def _layout(message_type: type[Message]) -> _Layout:
    proto = proto_type(message_type)
    declared = columns(message_type)
    of_parts = {
        column.part: proto.DESCRIPTOR.fields_by_name[column.part] for column in declared.values() if column.part
    }
    holders = {"": proto.DESCRIPTOR, **{name: field.message_type for name, field in of_parts.items()}}
    numbers = {name: holders[column.part].fields_by_name[name].number for name, column in declared.items()}
    packed = tuple(
        _PackedColumn(
            name,
            column,
            column.dtype.newbyteorder("<"),
            _varint(numbers[name] << 3 | _LENGTH_DELIMITED),
            _nothing(column.dtype) if column.optional else None,
        )
        for name, column in declared.items()
    )
    time = time_column(message_type)
    return _Layout(
        name=type_name(message_type),
        proto=proto,
        record=_record(message_type),
        columns=packed,
        parts={name: _varint(field.number << 3 | _LENGTH_DELIMITED) for name, field in of_parts.items()},
        time=time if time in declared else None,
    )


def _nothing(dtype: np.dtype[Any]) -> Array:
    nothing = np.zeros(0, dtype)
    nothing.setflags(write=False)
    return nothing


def _varint(value: int) -> bytes:
    out = bytearray()
    while value > 0x7F:
        out.append((value & 0x7F) | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)


def encode(message: Message) -> bytes:
    """Serialise a message.

    Raises:
        CodecError: a column's shape does not fit the message's samples and fans, or a value is out of its limits.
    """
    layout = _layout(type(message))
    _check_period(layout, message)
    proto = layout.proto()
    layout.record.write(message, proto)
    parts = [proto.SerializeToString()]
    nested: dict[str, list[bytes]] = {name: [] for name in layout.parts}
    samples, fans = _sample_count(layout, message), getattr(message, "fans", -1)
    with np.errstate(over="ignore"):  # beyond the range of float32 is infinite
        arrays = [np.asarray(getattr(message, column.name), dtype=column.dtype) for column in layout.columns]
    for column, values in zip(layout.columns, arrays, strict=True):
        if not values.size and column.nothing is not None:
            continue
        _check_shape(layout, column, values, samples, values.size if fans < 0 else fans)
        if values.size == 0:
            continue
        data = values.tobytes()
        if column.declared.enum is None:
            _check_limits(layout, column, values)
        elif not data.isascii():  # the quickest way to see that no byte is above 127
            raise _out_of_limits(layout, column)
        into = nested[column.declared.part] if column.declared.part else parts
        into += (column.key, _varint(len(data)), data)
    for name, of_part in nested.items():
        if data := b"".join(of_part):
            parts += (layout.parts[name], _varint(len(data)), data)
    return b"".join(parts)


def decode(message_type: type[AnyMessage], data: bytes, names: Collection[str] | None = None) -> AnyMessage:
    """Parse bytes into a message; columns come back read-only in their declared shape.

    An optional column that the message does not have is empty. Enum values of a newer version are kept.

    names: the columns that are needed, and the times; all others are left empty, which saves most of the time.

    Raises:
        CodecError: the bytes are not such a message.
    """
    layout = _layout(message_type)
    try:
        proto: Any = layout.proto.FromString(data)
    except DecodeError as error:
        raise CodecError(f"{len(data)} bytes are not a {layout.name}: {error}") from error
    values = layout.record.read(proto)
    fans = values.get("fans", -1)  # -1: a message without
    samples = len(getattr(proto, layout.time)) if layout.time else -1
    for column in layout.columns:
        if names is not None and column.name not in names and column.name != layout.time:
            continue
        part = column.declared.part
        field = getattr(getattr(proto, part) if part else proto, column.name)
        if column.nothing is not None and not field:
            values[column.name] = column.nothing
            continue
        array = _array(layout, column, field)
        if column.declared.shape == "samples x fans":
            if array.size and (fans == 0 or array.size % fans):
                raise CodecError(f"{layout.name}.{column.name} has {array.size} values for {fans} fans")
            array = array.reshape(-1 if array.size else 0, fans)
        array.setflags(write=False)
        _check_shape(layout, column, array, samples, array.size if fans < 0 else fans)
        values[column.name] = array
    message = message_type(**values)
    _check_period(layout, message)
    return message


def decode_header(message_type: type[Message], data: bytes) -> Any:
    """The header of a message (`fan_pb2.Header`), without decoding the rest. Raises CodecError."""
    try:
        if len(data) > 2 and data[0] == _HEADER_KEY:  # `encode` puts it first
            length, start = data[1], 2
            if length > 0x7F:
                length, start = (length & 0x7F) | data[2] << 7, 3
            if length < 1 << 14:
                return fan_pb2.Header.FromString(data[start : start + length])
        message: Any = proto_type(message_type).FromString(data)
    except DecodeError as error:
        raise CodecError(f"{len(data)} bytes are not a {type_name(message_type)}: {error}") from error
    return message.header


def _array(layout: _Layout, column: _PackedColumn, field: Any) -> Array:
    """The values of a packed field, (n,)."""
    values = field[:] if len(field) <= _SHORT else np.asarray(field)
    if len(values):
        _check_limits(layout, column, values)
    return np.asarray(values, column.declared.dtype)


def _sample_count(layout: _Layout, message: Message) -> int:
    """Samples in a message; -1 for messages about one moment."""
    return len(getattr(message, layout.time)) if layout.time else -1


def _check_period(layout: _Layout, message: Message) -> None:
    period_ns = getattr(message, "period_ns", 1)
    if not 0 < period_ns <= LARGEST_PERIOD_NS:
        raise CodecError(f"{layout.name}.period_ns = {period_ns}: a period is 1 ns to a day")


def _check_limits(layout: _Layout, column: _PackedColumn, values: list[int] | Array) -> None:
    """values: at least one."""
    if column.declared.limits is None:
        return
    lowest, highest = column.declared.limits
    if isinstance(values, list):
        fits = lowest <= min(values) and max(values) <= highest
    else:
        fits = lowest <= values.min() and values.max() <= highest
    if not fits:
        raise _out_of_limits(layout, column)


def _out_of_limits(layout: _Layout, column: _PackedColumn) -> CodecError:
    assert column.declared.limits is not None
    lowest, highest = column.declared.limits
    what = "enum values are" if column.declared.enum else "times in ns since 1970, up to the year 2116, are"
    return CodecError(f"{layout.name}.{column.name} holds a value out of its limits: {what} {lowest} to {highest}")


def _check_shape(layout: _Layout, column: _PackedColumn, values: Array, samples: int, fans: int) -> None:
    shape = column.declared.shape
    if shape == "samples x fans":
        expected: tuple[int, ...] = samples, fans
    else:
        expected = (samples if shape == "samples" else fans,)
    if values.shape != expected and not (values.size == 0 and (column.declared.optional or samples == 0)):
        raise CodecError(f"{layout.name}.{column.name} has shape {values.shape}, not {shape} = {expected}")


_Kind = TypeVar("_Kind", bound=Message)


def decode_together(kind: type[_Kind], payloads: Sequence[bytes], names: Collection[str] | None = None) -> list[_Kind]:
    """Messages of one type and one producer as few blocks as they allow, usually one. names: as in `decode`.

    Protobuf appends the packed columns of messages that are parsed one after the other, so many messages cost little
    more than one. Where their columns do not fit together, each is decoded by itself. (A producer has one number of
    fans.)

    Raises:
        CodecError: one of them cannot be decoded.
    """
    if not payloads:
        return []
    try:
        together = _once(decode(kind, b"".join(payloads), names), len(payloads))
    except CodecError:
        together = None
    return [decode(kind, payload, names) for payload in payloads] if together is None else [together]


def _once(message: _Kind, payloads: int) -> _Kind | None:
    """The message without repetitions of its tuples, which protobuf appends, too; None where they are not all equal."""
    found: dict[str, Any] = {}
    for name, values in vars(message).items():
        if isinstance(values, tuple) and values:
            found[name] = values[: len(values) // payloads]
            if found[name] * payloads != values:
                return None
    return replace(message, **found) if found else message
