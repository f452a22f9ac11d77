"""Recordings as NumPy arrays: blocks of a topic's columns, with one block of each tray in memory at a time.

A recording can consist of several files, its parts. See docs/how-to/read-recordings.md.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, fields
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from fantwin.pipeline.recordings.parts import Seen, in_order, read_parts
from fantwin.pipeline.recordings.reading import RecordingError
from fantwin.schemas.fields import (
    LARGEST_ENUM_VALUE,
    Array,
    OpenEnum,
    columns,
    derived_columns,
    other_fields,
    time_column,
)
from fantwin.schemas.messages import Message
from fantwin.schemas.topics import BY_NAME, HEALTH_CHUNK, TOPICS


@dataclass(frozen=True, eq=False)
class Block:
    """Successive rows of one topic of one tray: samples, or events if a message is about one moment.

    Attributes:
        tray: empty for the health of stages.
        fans: 0 for a topic without columns by fan.
        columns: (rows,) or (rows, fans), with the names and units of the message. A value that a message carries once
            is repeated in each of its rows. `producer` is the session that sent the row. A column that the device does
            not have is empty.
    """

    site: str
    tray: str
    topic: str
    fans: int
    columns: Mapping[str, Array]

    def __getitem__(self, name: str) -> Array:
        return self.columns[name]

    def __len__(self) -> int:
        return len(self.t_ns)

    def names(self, column: str) -> Array:
        """An enum column as names (`NORMAL`), str in the shape of the column; unknown values as numbers.

        Raises:
            ValueError: the column holds quantities.
        """
        enum = block_columns(BY_NAME[self.topic].message)[column].enum
        if enum is None:
            raise ValueError(f"{self.topic}.{column} is not an enum")
        return enum_names(enum)[self.columns[column]]

    @property
    def t_ns(self) -> Array:
        """(rows,) int64, ns since 1970: time of the samples or events; for `raw`, when the host received them."""
        return self.columns[time_column(BY_NAME[self.topic].message)]


@dataclass
class Arrays:
    """The blocks of a recording, to iterate over. Blocks of several trays or topics are interleaved.

    Attributes:
        damage: after the iteration, a line for each file that could not be read in full.
        duplicated: messages that were recorded twice and left out the second time.
    """

    paths: list[Path]
    topics: Collection[str]
    tray: str | None
    rows: int
    damage: list[str] = field(default_factory=list, init=False)
    duplicated: int = field(default=0, init=False)

    def __iter__(self) -> Iterator[Block]:
        self.damage, self.duplicated = [], 0
        gathered: dict[tuple[str, str, str], _Gathered] = {}
        seen = Seen()
        for envelope in read_parts(self.paths, self.topics, self.damage, self.tray, seen):
            if not _rows(envelope.message):
                continue
            source = (*_site_and_tray(envelope.key), envelope.topic)
            pending = gathered.get(source)
            if pending is not None and not pending.accepts(envelope.message):
                yield pending.block()
                pending = None
            if pending is None:
                pending = gathered[source] = _Gathered(*source, _form(envelope.message))
            pending.add(envelope.message)
            if pending.rows >= self.rows:
                yield gathered.pop(source).block()
        self.duplicated = seen.repeated
        for rest in gathered.values():
            yield rest.block()


def read_arrays(recording: Path | Iterable[Path], topic: str, tray: str | None = None, rows: int = 4096) -> Arrays:
    """Read the columns of one topic in blocks of at least `rows` rows.

    A block is shorter only at the end of a tray, or before a change of the number of fans.

    Args:
        recording: a file, or the parts of one recording in any order. A message that is in two parts counts once.
        topic: see docs/reference/messages.md.
        tray: the tray to read; None for all. The health of stages belongs to no tray and is always read.
        rows: rows of a block. As many are held in memory for each tray.

    Raises:
        RecordingError: a file cannot be read or is not a part of a recording, or the topic is unknown.
    """
    return read_topics([recording] if isinstance(recording, Path) else recording, (topic,), tray, rows)


def read_topics(parts: Iterable[Path], topics: Collection[str], tray: str | None = None, rows: int = 4096) -> Arrays:
    """Read several topics in one pass through the files; see `read_arrays`.

    Raises:
        RecordingError: as in `read_arrays`.
    """
    for topic in topics:
        if topic not in BY_NAME:
            known = ", ".join(known.name for known in TOPICS if known.recorded)
            raise RecordingError(f"no topic is called {topic!r}; known: {known}")
    return Arrays(in_order(parts), topics, tray, rows)


@dataclass(frozen=True)
class BlockColumn:
    """A column of a topic's blocks.

    Attributes:
        by_fan: shape (rows, fans), otherwise (rows,).
        once: a message carries one value for all its rows.
        enum: what the values mean: `enum(2).name`; None for quantities.
    """

    dtype: np.dtype[Any]
    by_fan: bool = False
    once: bool = False
    enum: type[OpenEnum] | None = None


@cache
def block_columns(message_type: type[Message]) -> Mapping[str, BlockColumn]:
    """The columns of a topic's blocks by name: the time first, then as in the message, `producer` last.

    Nested records are left out; `read_recording` gives them.
    """
    kinds = {bool: np.bool_, int: np.int64, float: np.float64, str: np.object_}
    declared = columns(message_type) | derived_columns(message_type)
    others = other_fields(message_type)
    found = {time_column(message_type): BlockColumn(np.dtype(np.int64))}
    own = (f.name for f in fields(message_type) if f.name != "fans")
    for name in (*own, *derived_columns(message_type)):
        if column := declared.get(name):
            found[name] = BlockColumn(column.dtype, column.by_fan, not column.by_sample, column.enum)
        elif others[name] in kinds:
            found[name] = BlockColumn(np.dtype(kinds[others[name]]), once=True)
        elif isinstance(enum := others[name], type) and issubclass(enum, OpenEnum):
            found[name] = BlockColumn(np.dtype(np.uint8), once=True, enum=enum)
    return found | {"producer": BlockColumn(np.dtype(np.object_), once=True)}


@cache
def enum_names(enum: type[OpenEnum]) -> Array:
    """The text for each value that a column of this enum can hold, (128,) of str; the number for an unknown value."""
    values = [enum(value) for value in range(LARGEST_ENUM_VALUE + 1)]
    return np.array([value.name if value.is_known else str(int(value)) for value in values], np.object_)


class _Gathered:
    """Messages of one form, gathered for one block."""

    def __init__(self, site: str, tray: str, topic: str, form: tuple[int, ...]) -> None:
        self.rows = 0
        self._of = (site, tray, topic)
        self._form = form
        self._messages: list[Message] = []

    def accepts(self, message: Message) -> bool:
        """Whether its columns have the same shapes."""
        return _form(message) == self._form

    def add(self, message: Message) -> None:
        self._messages.append(message)
        self.rows += _rows(message)

    def block(self) -> Block:
        counts = [_rows(message) for message in self._messages]
        found: dict[str, Array] = {}
        for name, column in block_columns(type(self._messages[0])).items():
            values = [
                message.header.producer if name == "producer" else getattr(message, name) for message in self._messages
            ]
            found[name] = (
                np.repeat(np.array(values, column.dtype), counts, axis=0) if column.once else np.concatenate(values)
            )
        return Block(*self._of, self._form[0], found)


def _rows(message: Message) -> int:
    name = time_column(type(message))
    return len(getattr(message, name)) if name in columns(type(message)) else 1


def _form(message: Message) -> tuple[int, ...]:
    """The number of fans, and which columns are empty: messages of the same form can be concatenated."""
    declared = columns(type(message))
    by_fan = (len(getattr(message, name)) for name, column in declared.items() if column.shape == "fans")
    fans = getattr(message, "fans", max(by_fan, default=0))
    return fans, *(number for number, name in enumerate(declared) if not getattr(message, name).size)


def _site_and_tray(key: str) -> tuple[str, str]:
    _, site, tray, *_ = key.split("/")
    return site, "" if tray == HEALTH_CHUNK else tray
