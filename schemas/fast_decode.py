"""Shortcuts for readers of hundreds of thousands of messages: only the header, or many messages as one block."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeVar

from google.protobuf.message import DecodeError

from schemas import fan_pb2
from schemas.codec import CodecError, decode, proto_type
from schemas.envelope import Envelope
from schemas.messages import Message
from schemas.topics import BY_NAME

_HEADER_FIELD = 0x0A
_Kind = TypeVar("_Kind", bound=Message)


def decode_header(envelope: Envelope) -> Any:
    """The header of a message (`fan_pb2.Header`), without decoding the rest. Raises CodecError."""
    payload = envelope.payload
    try:
        if len(payload) > 2 and payload[0] == _HEADER_FIELD:  # our own codec puts it first
            length, start = payload[1], 2
            if length > 0x7F:
                length, start = (length & 0x7F) | payload[2] << 7, 3
            if length < 1 << 14:
                return fan_pb2.Header.FromString(payload[start : start + length])
        message: Any = proto_type(BY_NAME[envelope.topic].message).FromString(payload)
    except DecodeError as error:
        raise CodecError(f"{envelope.key}: {error}") from error
    return message.header


def decode_together(kind: type[_Kind], payloads: Sequence[bytes]) -> list[_Kind]:
    """Messages of one type and one producer as few blocks as they allow, usually one.

    Protobuf appends the packed columns of messages that are parsed one after the other, so many messages cost little
    more than one. Where their columns do not fit together, each is decoded by itself. (A producer has one number of
    fans.)

    Raises:
        CodecError: one of them cannot be decoded.
    """
    if not payloads:
        return []
    try:
        return [_decode(kind, b"".join(payloads))]
    except CodecError:
        return [_decode(kind, payload) for payload in payloads]


def _decode(kind: type[_Kind], payload: bytes) -> _Kind:
    message = decode(kind, payload)
    assert isinstance(message, kind)
    return message
