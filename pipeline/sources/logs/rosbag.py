"""ROS 2 bags, in SQLite or MCAP: fields are called `/topic.field`, with `[i]` for an element of an array.

The time of a value is `header.stamp` of its message, if it has one that is set; otherwise when the bag got it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fantwin.pipeline.sources.logs.log_file import LogError, Series
from fantwin.schemas.units import NS_PER_S

MOST_ELEMENTS = 1024
"""elements of an array; a longer one is an image or a cloud and no row of fans"""


_NO_VALUES = ("header", "layout")
"""fields with a time, or the shape of an array"""


class RosbagFile:
    """A bag whose messages have been read."""

    def __init__(self, path: Path) -> None:
        """Raises LogError."""
        from rosbags.highlevel import AnyReader  # noqa: PLC0415  an extra
        from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415

        self._path = path
        self._times: dict[str, list[int]] = {}
        self._values: dict[str, list[float]] = {}
        by_receipt: set[str] = set()
        unknown: dict[str, str] = {}
        try:
            # old bags in SQLite do not hold their types; those of ROS itself are then known
            with AnyReader([path], default_typestore=get_typestore(Stores.LATEST)) as reader:
                for connection, received_t_ns, data in reader.messages():
                    try:
                        message = reader.deserialize(data, connection.msgtype)
                    except KeyError:
                        unknown[connection.topic] = connection.msgtype
                        continue
                    t_ns = _stamp_ns(message)
                    if t_ns is None:
                        by_receipt.add(connection.topic)
                    for name, value in _numbers(connection.topic, message):
                        self._times.setdefault(name, []).append(received_t_ns if t_ns is None else t_ns)
                        self._values.setdefault(name, []).append(value)
        except Exception as error:
            raise LogError(f"{path}: no ROS 2 bag that can be read: {error}") from error
        self.names: Sequence[str] = list(self._values)
        self._by_receipt = by_receipt
        self.notes: Sequence[str] = [
            f"{topic} is left out: the bag does not define its type {kind}" for topic, kind in sorted(unknown.items())
        ]

    def read(self, names: Sequence[str]) -> Mapping[str, Series]:
        """See LogFile."""
        used = sorted({name.partition(".")[0] for name in names} & self._by_receipt)
        if used:
            text = f"{', '.join(used)}: messages without a time of their own; that of the bag is used"
            self.notes = [*self.notes, text]
        return {name: Series(np.array(self._times[name], np.int64), np.array(self._values[name])) for name in names}


def _stamp_ns(message: Any) -> int | None:
    stamp = getattr(getattr(message, "header", None), "stamp", None)
    t_ns = stamp.sec * NS_PER_S + stamp.nanosec if stamp is not None else 0
    return t_ns or None


def _numbers(name: str, value: Any) -> Iterator[tuple[str, float]]:
    """The numbers of a message, with their names."""
    if isinstance(value, bool | int | float | np.number):
        yield name, float(value)
    elif is_dataclass(value):
        for field in fields(value):
            if field.name not in _NO_VALUES and not field.name.startswith("__"):
                yield from _numbers(f"{name}.{field.name}", getattr(value, field.name))
    elif isinstance(value, np.ndarray | list | tuple) and len(value) <= MOST_ELEMENTS:
        for number, element in enumerate(value):
            yield from _numbers(f"{name}[{number}]", element)
