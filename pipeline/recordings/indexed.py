"""A recording read by its index: only the chunks that have messages of the topics asked for.

Rare messages, such as alarms, are found without reading the rest. A file without an index, such as one that is still
being written, gets one in memory, from the headers of its chunks.
"""

from __future__ import annotations

import struct
from collections.abc import Collection, Iterator
from contextlib import suppress
from pathlib import Path

from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, ChunkIndex

from fantwin.pipeline.recordings.reading import Reading, read_recording
from fantwin.pipeline.recordings.records import (
    ACTIVE_SUFFIX,
    CORRUPT_DATA_ERRORS,
    RecordReader,
    chunk_at,
    may_hold,
    parse,
    records_in,
    summary_of,
)
from fantwin.schemas.codec import CodecError
from fantwin.schemas.envelope import Envelope


class IndexedRecording:
    """The chunks of one file, in its order.

    Attributes:
        reading: counts what could not be read.
        channels: key and topic of each wanted channel, by its number.
        chunks: those that may hold messages of these channels.
    """

    def __init__(self, path: Path, topics: Collection[str] | None = None, tray: str | None = None) -> None:
        """topics, tray: those wanted; None: all. The health of stages belongs to no tray, and is wanted with any.

        Raises:
            OSError, RecordingError: the file cannot be read, is not a recording, or is of an unknown format.
        """
        self._path = path
        self.reading = Reading(path, topics, tray)
        self.channels: dict[int, tuple[str, str]] = {}
        summary = summary_of(path)
        channels, chunks = summary.channels, summary.chunk_indexes
        if not chunks:
            channels, chunks = index_of(path)
        for channel in channels.values():
            self.reading.add_channel(channel, self.channels)
        in_order = sorted(chunks, key=lambda chunk: chunk.chunk_start_offset)
        self.chunks = [chunk for chunk in in_order if may_hold(chunk, self.channels.keys())]
        self.first_ns = min((chunk.message_start_time for chunk in in_order), default=0)
        self.last_ns = max((chunk.message_end_time for chunk in in_order), default=0)

    @property
    def file(self) -> Path:
        """The file, which may have been finished since."""
        if self._path.name.endswith(ACTIVE_SUFFIX) and not self._path.exists():
            return self._path.with_name(self._path.name.removesuffix(ACTIVE_SUFFIX))
        return self._path

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


def index_of(path: Path) -> tuple[dict[int, Channel], list[ChunkIndex]]:
    """The channels and chunks of a file without an index. Only chunks that describe a channel are opened."""
    channels: dict[int, Channel] = {}
    chunks: list[ChunkIndex] = []
    reader = RecordReader(path)
    for record in reader:
        if isinstance(record.parsed, Channel):
            channels[record.parsed.id] = record.parsed
        elif isinstance(chunk := record.parsed, Chunk):
            chunks.append(
                ChunkIndex(
                    chunk_length=record.end - record.offset,
                    chunk_start_offset=record.offset,
                    compression=chunk.compression,
                    compressed_size=len(chunk.data),
                    message_end_time=chunk.message_end_time,
                    message_index_length=0,
                    message_index_offsets={},
                    message_start_time=chunk.message_start_time,
                    uncompressed_size=chunk.uncompressed_size,
                )
            )
        elif record.opcode == Opcode.MESSAGE_INDEX and chunks:
            chunks[-1].message_index_offsets[struct.unpack_from("<H", record.content)[0]] = record.offset
            chunks[-1].message_index_length += record.end - record.offset
    for number, chunk in enumerate(chunks):
        held = chunk.message_index_offsets
        if reader.damaged_ranges or number == len(chunks) - 1:
            held.clear()  # some may be missing: `may_hold` then takes it for any channel
            chunk.message_index_length = 0
        if not (held and held.keys() <= channels.keys()):
            channels |= _channels_in(path, chunk)
    return channels, chunks


def _channels_in(path: Path, chunk: ChunkIndex) -> dict[int, Channel]:
    """The channels that a chunk describes; none if it is damaged."""
    with suppress(*CORRUPT_DATA_ERRORS), path.open("rb") as file:
        data = chunk_at(file, chunk)
        described = (data[start:end] for _, opcode, start, end in records_in(data) if opcode == Opcode.CHANNEL)
        return {channel.id: channel for channel in (parse(Channel, content) for content in described)}
    return {}


def rare_messages(path: Path, topic: str) -> list[Envelope]:
    """The messages of a topic in the order they were recorded; those that cannot be decoded are left out.

    They are found by the file's index. If something is damaged, the whole file is read.

    Raises:
        RecordingError: the file cannot be read or is not a recording.
    """
    with suppress(OSError, CodecError, *CORRUPT_DATA_ERRORS):
        return [envelope for envelope in IndexedRecording(path, (topic,)) if envelope.message]
    return list(read_recording(path, (topic,)))


def last_messages(path: Path, topic: str) -> dict[str, bytes]:
    """The last message of a topic on each key, as bytes. Found as in `rare_messages`.

    Raises:
        RecordingError: the file cannot be read or is not a recording.
    """
    found: dict[str, bytes] = {}
    with suppress(OSError, *CORRUPT_DATA_ERRORS):
        indexed = IndexedRecording(path, (topic,))
        for chunk in reversed(indexed.chunks):
            missing = {number for number, (key, _) in indexed.channels.items() if key not in found}
            if missing and may_hold(chunk, missing):
                found = {envelope.key: envelope.payload for envelope in indexed.envelopes(chunk)} | found
        return found
    return {envelope.key: envelope.payload for envelope in rare_messages(path, topic)}


def last_message_ns(path: Path) -> int:
    """When the last message of a recording was received; 0 without any.

    Raises:
        RecordingError: it is not a recording, or of an unknown format.
    """
    try:
        return IndexedRecording(path).last_ns
    except OSError:
        return 0
