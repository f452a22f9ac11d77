"""Messages of several trays put side by side into one with the fans of all, and one taken apart again.

Messages with the same number of samples can be processed in one pass, which costs little more than one of them alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np

from fantwin.schemas.fields import Array, columns
from fantwin.schemas.messages import Message

AnyMessage = TypeVar("AnyMessage", bound=Message)


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
