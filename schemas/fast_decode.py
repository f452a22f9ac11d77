"""A shortcut for readers of hundreds of thousands of messages: many as one block."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, TypeVar

from fantwin.schemas.codec import CodecError, decode
from fantwin.schemas.messages import Message

_Kind = TypeVar("_Kind", bound=Message)


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
        together = _once(decode(kind, b"".join(payloads)), len(payloads))
    except CodecError:
        together = None
    return [decode(kind, payload) for payload in payloads] if together is None else [together]


def _once(message: _Kind, payloads: int) -> _Kind | None:
    """The message without repetitions of its tuples, which protobuf appends, too; None where they are not all equal."""
    found: dict[str, Any] = {}
    for name, values in vars(message).items():
        if isinstance(values, tuple) and values:
            found[name] = values[: len(values) // payloads]
            if found[name] * payloads != values:
                return None
    return replace(message, **found) if found else message
