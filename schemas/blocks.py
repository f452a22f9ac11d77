"""Blocks: several messages of one kind made one, and one cut into several.

A message holds one sample or many (docs/reference/messages.md); what a stage makes of samples does not depend on how
they are cut
into messages. So whoever has many small messages at hand may join them and spare the work that each one costs.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from operator import attrgetter
from typing import Any, TypeVar

import numpy as np

from schemas.messages import MESSAGE_TYPES, Array, Message, columns

AnyMessage = TypeVar("AnyMessage", bound=Message)


@dataclass(frozen=True)
class _Form:
    """What two messages of a kind must have in common to be joined, and what is joined."""

    of_samples: tuple[str, ...]
    of_fans: tuple[str, ...]
    optional: tuple[str, ...]  # columns of samples that some devices do not have
    scalars: Callable[[Message], Any]


def _form(message_type: type[Message]) -> _Form:
    shapes = {name: shape for name, (shape, _) in columns(message_type).items()}
    scalars = [f.name for f in fields(message_type) if f.name not in shapes and f.name != "header"]
    return _Form(
        of_samples=tuple(name for name, shape in shapes.items() if shape != "fans"),
        of_fans=tuple(name for name, shape in shapes.items() if shape == "fans"),
        optional=tuple(name for name, shape in shapes.items() if shape == "samples")[1:],
        scalars=attrgetter(*scalars),
    )


_FORMS = {t: _form(t) for t in MESSAGE_TYPES}


def can_join(one: Message, other: Message) -> bool:
    """Whether two messages differ in their samples only, and have the same columns of them."""
    if type(other) is not type(one):
        return False
    form = _FORMS[type(one)]
    if not form.of_samples or form.scalars(one) != form.scalars(other):
        return False
    for name in form.of_fans:
        mine, others = getattr(one, name), getattr(other, name)
        if mine is not others and not np.array_equal(mine, others, equal_nan=True):
            return False
    return not form.optional or _has_columns(one, form) == _has_columns(other, form)


def join(messages: Sequence[AnyMessage]) -> AnyMessage:
    """One message with the samples of all, in their order, and the first one's header.

    Raises:
        ValueError: no messages, or some that differ in more than their samples.
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
        first, **{name: np.concatenate([getattr(m, name) for m in messages]) for name in _FORMS[type(first)].of_samples}
    )


def cut(message: AnyMessage, first: int, end: int) -> AnyMessage:
    """The samples from `first` up to and without `end`, counted from 0, and the header. Columns are views.

    Raises:
        ValueError: a message without samples, or without those.
    """
    of_samples = _FORMS[type(message)].of_samples
    if not of_samples or not 0 <= first <= end <= len(getattr(message, of_samples[0])):
        raise ValueError(f"a {type(message).__name__} without samples {first} to {end}")
    return replace(message, **{name: getattr(message, name)[first:end] for name in of_samples})


def chosen(message: AnyMessage, rows: Array) -> AnyMessage:
    """Some of the samples, (n,) of bool, and the header."""
    of_samples = {name: getattr(message, name) for name in _FORMS[type(message)].of_samples}
    return replace(message, **{name: values[rows] if len(values) else values for name, values in of_samples.items()})


def _has_columns(message: Message, form: _Form) -> list[bool]:
    samples = len(getattr(message, form.of_samples[0]))
    return [len(getattr(message, name)) == samples for name in form.optional]
