"""A recording read by its index: only the chunks that have messages of the topics asked for.

Messages of a topic of which a recording has few are found so without reading the rest.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from mcap.records import Channel, ChunkIndex

from fantwin.pipeline.recordings.reading import Reading, read_recording
from fantwin.pipeline.recordings.records import (
    ACTIVE_SUFFIX,
    CORRUPT_DATA_ERRORS,
    chunk_at,
    indexed_reader,
    may_hold,
)
from fantwin.schemas.codec import CodecError
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


def rare_messages(path: Path, topic: str) -> list[Envelope]:
    """The messages of a topic in the order they were recorded; those that cannot be decoded are left out.

    They are found by the file's index. If it has none, as after a crash, or something is damaged, the whole file is
    read.

    Raises:
        RecordingError: the file cannot be read or is not a recording.
    """
    try:
        if indexed := IndexedRecording.of(path, (topic,)):
            return [envelope for envelope in indexed if envelope.message]
    except (OSError, CodecError, *CORRUPT_DATA_ERRORS):
        pass  # reading all of it reports what is wrong
    return list(read_recording(path, (topic,)))


def last_messages(path: Path, topic: str) -> dict[str, bytes]:
    """The last message of a topic on each key, as bytes. Found as in `rare_messages`.

    Raises:
        RecordingError: the file cannot be read or is not a recording.
    """
    found: dict[str, bytes] = {}
    try:
        if indexed := IndexedRecording.of(path, (topic,)):
            for chunk in reversed(indexed.chunks):
                missing = {number for number, (key, _) in indexed.channels.items() if key not in found}
                if missing and may_hold(chunk, missing):
                    found = {envelope.key: envelope.payload for envelope in indexed.envelopes(chunk)} | found
            return found
    except (OSError, *CORRUPT_DATA_ERRORS):
        pass
    return {envelope.key: envelope.payload for envelope in rare_messages(path, topic)}


def last_message_ns(path: Path) -> int:
    """When the last message of a finished recording was received; 0 if its index does not say it.

    Raises:
        RecordingError: it is of an unknown format.
    """
    try:
        indexed = IndexedRecording.of(path)
    except OSError:
        return 0
    return indexed.last_ns if indexed else 0
