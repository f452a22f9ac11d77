"""Recordings as NumPy arrays: the columns of a topic in blocks of samples, one block of each tray in memory at a time.

A recording may lie in several files, the parts of one. See docs/how-to/read-recordings.md.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, fields
from enum import IntEnum
from pathlib import Path
from typing import Any, get_type_hints

import numpy as np

from pipeline.recordings.order import Seen, in_order
from pipeline.recordings.reading import RecordingError, read_recording
from schemas.envelope import Envelope
from schemas.messages import MESSAGE_TYPES, Array, FanState, InvalidReason, Message, Severity, StageStatus, columns
from schemas.topics import BY_NAME, HEALTH_CHUNK, TOPICS

WORDS: Mapping[str, type[IntEnum]] = {
    "state": FanState,
    "invalid_reason": InvalidReason,
    "severity": Severity,
    "status": StageStatus,
}
"""The columns that hold codes, and what these mean: `WORDS["state"](2).name` is SUSPECT."""


@dataclass(frozen=True, eq=False)
class Block:
    """Successive rows of one topic of one tray: samples, or events where a message is about one moment.

    columns: (rows,) or (rows, fans), named as in the message and with the same units; what a message says once stands
    in each of its rows. `producer` is the session that sent the row. A column that the device does not have is empty.
    """

    site: str
    tray: str
    """empty for the health of stages"""
    topic: str
    fans: int
    """0 for a topic that has no columns by fan"""
    columns: Mapping[str, Array]

    def __getitem__(self, name: str) -> Array:
        return self.columns[name]

    def __len__(self) -> int:
        return len(self.t_ns)

    @property
    def t_ns(self) -> Array:
        """(rows,) int64, ns since 1970: of the samples or events; of `raw`, when the host received them."""
        return self.columns[time_column(BY_NAME[self.topic].message)]


@dataclass
class Arrays:
    """The blocks of a recording, to iterate over; those of several trays or topics come in turns.

    Once they are through, `damage` has a line for each file that could not be read in full.
    """

    paths: list[Path]
    topics: Collection[str]
    tray: str | None
    rows: int
    damage: list[str] = field(default_factory=list, init=False)
    duplicated: int = field(default=0, init=False)
    """messages that came again, and were left out"""

    def __iter__(self) -> Iterator[Block]:
        self.damage, self.duplicated = [], 0
        gathered: dict[tuple[str, str, str], _Gathered] = {}
        for entry in self._entries():
            if not _rows(entry.message):
                continue
            whose = (*_site_and_tray(entry.key), entry.topic)
            mine = gathered.get(whose)
            if mine is not None and not mine.takes(entry.message):
                yield mine.block()
                mine = None
            if mine is None:
                mine = gathered[whose] = _Gathered(*whose, _form(entry.message))
            mine.add(entry.message)
            if mine.rows >= self.rows:
                yield gathered.pop(whose).block()
        for rest in gathered.values():
            yield rest.block()

    def _entries(self) -> Iterator[Envelope]:
        """The messages of all parts, each once."""
        seen: dict[tuple[str, str], Seen] = {}
        for path in self.paths:
            reading = read_recording(path, self.topics)
            for entry in reading:
                if self.tray is not None and _site_and_tray(entry.key)[1] not in ("", self.tray):
                    continue
                header = entry.message.header
                if seen.setdefault((entry.key, header.producer), Seen()).is_new(header.sequence):
                    yield entry
                else:
                    self.duplicated += 1
            if reading.damage:
                self.damage.append(reading.damage)


def read_arrays(recording: Path | Iterable[Path], topic: str, tray: str | None = None, rows: int = 4096) -> Arrays:
    """The columns of a topic, in blocks of `rows` rows or a little more; only the last of a tray may be shorter, and
    one after which the number of fans changes.

    Args:
        recording: a file, or the parts of one recording in any order. A message that is in two parts counts once.
        topic: see docs/reference/messages.md.
        tray: only this one; None for all. A stage's health is of no tray and always there.
        rows: in a block. As many of each tray are in memory.

    Raises:
        RecordingError: a file cannot be read, is no part of a recording, or there is no such topic.
    """
    return read_topics([recording] if isinstance(recording, Path) else recording, (topic,), tray, rows)


def read_topics(parts: Iterable[Path], topics: Collection[str], tray: str | None = None, rows: int = 4096) -> Arrays:
    """The same for several topics, in one go through the files.

    Raises:
        RecordingError: as in `read_arrays`.
    """
    for topic in topics:
        if topic not in BY_NAME:
            known = ", ".join(known.name for known in TOPICS if known.recorded)
            raise RecordingError(f"no topic is called {topic!r}; known: {known}")
    return Arrays(in_order(parts), topics, tray, rows)


@dataclass(frozen=True)
class Column:
    """A column of a topic's blocks; `once`: said once in a message, for all its rows."""

    dtype: np.dtype[Any]
    by_fan: bool
    once: bool


def block_columns(message_type: type[Message]) -> dict[str, Column]:
    """The columns of a topic's blocks by name: the time first, then as in the message, `producer` last.

    Lists of records are left out: `read_recording` has them.
    """
    kinds = {bool: np.bool_, int: np.int64, float: np.float64, str: np.object_}
    shapes, hints = columns(message_type), get_type_hints(message_type)
    found = {time_column(message_type): Column(np.dtype(np.int64), by_fan=False, once=False)}
    for f in fields(message_type):
        if f.name in shapes:
            shape, dtype = shapes[f.name]
            found[f.name] = Column(dtype, by_fan="fans" in shape, once="samples" not in shape)
        elif f.name != "fans" and (f.name in WORDS or hints[f.name] in kinds):
            dtype = np.dtype(np.uint8 if f.name in WORDS else kinds[hints[f.name]])
            found[f.name] = Column(dtype, by_fan=False, once=True)
    return found | {"producer": Column(np.dtype(np.object_), by_fan=False, once=True)}


def time_column(message_type: type[Message]) -> str:
    """Name of the column that says when: of a message's samples, or of the event it is about."""
    return next((name for name, (shape, _) in columns(message_type).items() if shape == "samples"), "t_ns")


class _Gathered:
    """Messages of one form that will be one block."""

    def __init__(self, site: str, tray: str, topic: str, form: tuple[int, ...]) -> None:
        self.rows = 0
        self._of = (site, tray, topic)
        self._form = form
        self._messages: list[Message] = []

    def takes(self, message: Message) -> bool:
        """Whether its columns have the same shapes."""
        return _form(message) == self._form

    def add(self, message: Message) -> None:
        self._messages.append(message)
        self.rows += _rows(message)

    def block(self) -> Block:
        counts = [_rows(message) for message in self._messages]
        found: dict[str, Array] = {}
        for name, column in block_columns(type(self._messages[0])).items():
            said = [
                message.header.producer if name == "producer" else getattr(message, name) for message in self._messages
            ]
            found[name] = (
                np.repeat(np.array(said, column.dtype), counts, axis=0) if column.once else np.concatenate(said)
            )
        return Block(*self._of, self._form[0], found)


_COLUMNS = {kind: columns(kind) for kind in MESSAGE_TYPES}
_TIME = {kind: time_column(kind) for kind in MESSAGE_TYPES}


def _rows(message: Message) -> int:
    name = _TIME[type(message)]
    return len(getattr(message, name)) if name in _COLUMNS[type(message)] else 1


def _form(message: Message) -> tuple[int, ...]:
    """Its fans, and which of its columns are not there: messages of one form fit beneath one another."""
    shapes = _COLUMNS[type(message)]
    by_fan = (len(getattr(message, name)) for name, (shape, _) in shapes.items() if shape == "fans")
    fans = getattr(message, "fans", max(by_fan, default=0))
    return fans, *(number for number, name in enumerate(shapes) if not getattr(message, name).size)


def _site_and_tray(key: str) -> tuple[str, str]:
    _, site, tray, *_ = key.split("/")
    return site, "" if tray == HEALTH_CHUNK else tray
