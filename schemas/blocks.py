"""Joining messages of one type into one, and cutting one into several.

A message holds one sample or many (docs/reference/messages.md), and the output of a stage does not depend on how its
input is cut. A stage that has many small messages at hand can therefore join them and save the cost per message.

Messages of several trays with the same number of samples can be put side by side, into one with the fans of all, and
taken apart again. Processed in one pass they cost little more than one of them alone.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from operator import attrgetter
from typing import Any, TypeVar

import numpy as np

from fantwin.schemas.fields import Array, columns, other_fields
from fantwin.schemas.messages import Message

AnyMessage = TypeVar("AnyMessage", bound=Message)


@dataclass(frozen=True)
class _Form:
    """The columns that are joined, and what two messages of a kind must have in common for that.

    Attributes:
        by_sample: columns with an axis of samples, which are joined.
        by_fan: columns without one; they must be equal.
        optional: columns of samples that both or neither must have.
        scalars: gives the other fields but the header; they must be equal.
    """

    by_sample: tuple[str, ...]
    by_fan: tuple[str, ...]
    optional: tuple[str, ...]
    scalars: Callable[[Message], Any]


@cache
def _form(message_type: type[Message]) -> _Form:
    declared = columns(message_type).items()
    return _Form(
        by_sample=tuple(name for name, column in declared if column.by_sample),
        by_fan=tuple(name for name, column in declared if not column.by_sample),
        optional=tuple(name for name, column in declared if column.by_sample and column.optional),
        scalars=attrgetter(*(name for name in other_fields(message_type) if name != "header")),
    )


def can_join(one: Message, other: Message) -> bool:
    """Whether two messages differ only in their samples and have the same columns."""
    if type(other) is not type(one):
        return False
    form = _form(type(one))
    if not form.by_sample or form.scalars(one) != form.scalars(other):
        return False
    for name in form.by_fan:
        mine, others = getattr(one, name), getattr(other, name)
        if mine is not others and not np.array_equal(mine, others, equal_nan=True):
            return False
    return not form.optional or _has_columns(one, form) == _has_columns(other, form)


def samples_of(message: Message) -> int:
    """The number of samples of a message; 0 of one whose kind has none."""
    by_sample = _form(type(message)).by_sample
    return len(getattr(message, by_sample[0])) if by_sample else 0


def join(messages: Sequence[AnyMessage]) -> AnyMessage:
    """One message with the samples of all messages in order, and the header of the first.

    Raises:
        ValueError: there are no messages, or they differ in more than their samples.
    """
    if not messages:
        raise ValueError("no messages to join")
    first, *others = messages
    if not others:
        return first
    for number, message in enumerate(others, 1):
        if not can_join(first, message):
            raise ValueError(
                f"message {number}, a {type(message).__name__}, differs from message 0 in more than samples"
            )
    return replace(
        first, **{name: np.concatenate([getattr(m, name) for m in messages]) for name in _form(type(first)).by_sample}
    )


def cut(message: AnyMessage, first: int, end: int) -> AnyMessage:
    """A message with the samples `first` to `end - 1`, counted from 0, and the same header. Columns are views.

    Raises:
        ValueError: the message does not have these samples.
    """
    by_sample = _form(type(message)).by_sample
    if not by_sample or not 0 <= first <= end <= len(getattr(message, by_sample[0])):
        raise ValueError(f"a {type(message).__name__} without samples {first} to {end}")
    return replace(message, **{name: getattr(message, name)[first:end] for name in by_sample})


def select(message: AnyMessage, rows: Array) -> AnyMessage:
    """A message with the samples selected by `rows`, (n,) of bool, and the same header."""
    by_sample = {name: getattr(message, name) for name in _form(type(message)).by_sample}
    return replace(message, **{name: values[rows] if len(values) else values for name, values in by_sample.items()})


def _has_columns(message: Message, form: _Form) -> list[bool]:
    samples = samples_of(message)
    return [len(getattr(message, name)) == samples for name in form.optional]


def side_by_side(messages: Sequence[AnyMessage]) -> AnyMessage:
    """One message with the fans of all in order; the rest is that of the first, also the times. They have the same
    number of samples, and the same optional columns (`present_columns`).
    """
    of_all: Sequence[Any] = messages
    first = of_all[0]
    joined = {
        name: np.concatenate([getattr(message, name) for message in messages], axis=-1)
        for name, column in columns(type(first)).items()
        if column.by_fan
    }
    return replace(first, fans=sum(message.fans for message in of_all), **joined)


def apart(message: AnyMessage, t_ns: Sequence[Array]) -> list[AnyMessage]:
    """A message for each of several trays with equal numbers of fans, and with these times, (n,). Columns are views."""
    of_all: Any = message
    fans = of_all.fans // len(t_ns)
    by_fan = [(name, getattr(message, name)) for name, column in columns(type(message)).items() if column.by_fan]
    return [
        replace(of_all, fans=fans, t_ns=times, **{name: of[..., k * fans : (k + 1) * fans] for name, of in by_fan})
        for k, times in enumerate(t_ns)
    ]


def present_columns(message: Message) -> tuple[str, ...]:
    """The optional columns that a message has."""
    declared = columns(type(message)).items()
    return tuple(name for name, column in declared if column.optional and len(getattr(message, name)))
