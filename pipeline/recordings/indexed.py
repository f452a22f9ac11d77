"""A recording read by its index: only the chunks that have messages of the topics asked for."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from mcap.records import Channel, ChunkIndex

from fantwin.pipeline.recordings.reading import Reading
from fantwin.pipeline.recordings.records import (
    ACTIVE_SUFFIX,
    CORRUPT_DATA_ERRORS,
    chunk_at,
    indexed_reader,
    may_hold,
)
from fantwin.schemas.envelope import Envelope


@dataclass(frozen=True)
class PartIndex:
    """Where the chunks of a file are."""

    path: Path
    channels: Mapping[int, Channel]
    chunks: Sequence[ChunkIndex]


class IndexedRecording:
    """The chunks of one file, in its order.

    Attributes:
        reading: counts what could not be read.
        channels: key and topic of each wanted channel, by its number.
        chunks: those that may hold messages of these channels.
    """

    def __init__(self, index: PartIndex, topics: Collection[str] | None = None, tray: str | None = None) -> None:
        """topics, tray: those wanted; None: all. The health of stages belongs to no tray, and is wanted with any."""
        self._path = index.path
        self.reading = Reading(index.path, topics, tray)
        self.channels: dict[int, tuple[str, str]] = {}
        for channel in index.channels.values():
            self.reading.add_channel(channel, self.channels)
        in_order = sorted(index.chunks, key=lambda chunk: chunk.chunk_start_offset)
        self.chunks = [chunk for chunk in in_order if may_hold(chunk, self.channels.keys())]
        self.first_ns = min((chunk.message_start_time for chunk in in_order), default=0)
        self.last_ns = max((chunk.message_end_time for chunk in in_order), default=0)

    @classmethod
    def of(cls, path: Path, topics: Collection[str] | None = None, tray: str | None = None) -> Self | None:
        """None if the file has no index that lists chunks.

        Raises:
            OSError: it cannot be read.
            RecordingError: it is of an unknown format.
        """
        with suppress(LookupError, *CORRUPT_DATA_ERRORS), path.open("rb") as file:
            summary = indexed_reader(file).get_summary()
            if summary and summary.chunk_indexes:
                return cls(PartIndex(path, summary.channels, summary.chunk_indexes), topics, tray)
        return None

    @property
    def file(self) -> Path:
        """The file, which may have been finished since."""
        if self._path.name.endswith(ACTIVE_SUFFIX) and not self._path.exists():
            return self._path.with_name(self._path.name.removesuffix(ACTIVE_SUFFIX))
        return self._path

    def channels_of(self, key: str) -> set[int]:
        """The numbers of the channels of a key."""
        return {number for number, (name, _) in self.channels.items() if name == key}

    def envelopes(self, chunk: ChunkIndex) -> list[Envelope]:
        """The wanted messages of a chunk, as bytes.

        Raises:
            OSError: the file is gone.
            one of CORRUPT_DATA_ERRORS: the chunk is damaged.
        """
        with self.file.open("rb") as file:
            data = chunk_at(file, chunk)
        return self.reading.envelopes_in(data, self.channels)

    def __iter__(self) -> Iterator[Envelope]:
        """All wanted messages, as bytes. Raises as `envelopes`."""
        for chunk in self.chunks:
            yield from self.envelopes(chunk)
