"""Reading recordings: MCAP files that hold what went over the bus, as any MCAP reader understands it.

A channel is a key of the bus, its messages are the protobuf bytes that were sent, and the schema is embedded. A file
that breaks off, or is damaged in the middle, is read as far as it goes. See docs/reference/recordings.md.
"""

from __future__ import annotations

import struct
from collections.abc import Collection, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from mcap.exceptions import McapError
from mcap.records import Attachment, Channel, Chunk, McapRecord, Metadata
from mcap.records import Message as McapMessage
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import MCAP0_MAGIC
from zstandard import ZstdError

from pipeline.errors import UserError
from schemas.codec import CodecError, decode
from schemas.messages import Message
from schemas.topics import Topic, topic_of

METADATA_NAME = "fantwin"


class RecordingError(UserError):
    """A recording cannot be read, or not be written any more: one line."""


@dataclass(frozen=True, slots=True)
class Entry:
    """One message of a recording."""

    key: str
    topic: str
    message: Message
    log_time_ns: int
    """when it was received"""


@dataclass
class Reading:
    """The messages of a recording, in the order they were received; one chunk at a time is in memory.

    What cannot be read is left out and counted: once the messages are through, `damage` says what it was.
    """

    path: Path
    topics: Collection[str] | None
    torn: bool = field(default=False, init=False)
    """the file breaks off: its recorder was killed, or lost its power"""
    damaged_chunks: int = field(default=0, init=False)
    undecodable: int = field(default=0, init=False)
    """messages that are not what their channel says"""

    @property
    def damage(self) -> str:
        """One line on what could not be read; empty when all could."""
        found = (
            ("it breaks off, as after a crash; read up to there", self.torn),
            (f"damaged chunks left out: {self.damaged_chunks}", self.damaged_chunks),
            (f"messages left out that cannot be decoded: {self.undecodable}", self.undecodable),
        )
        said = "; ".join(text for text, is_so in found if is_so)
        return f"{self.path}: {said}" if said else ""

    def __iter__(self) -> Iterator[Entry]:
        self.torn, self.damaged_chunks, self.undecodable = False, 0, 0
        channels: dict[int, tuple[str, Topic] | None] = {}
        for record in self._records():
            if isinstance(record, Channel):
                channels[record.id] = _key_and_topic(record)
            elif isinstance(record, McapMessage):
                channel = channels.get(record.channel_id)
                if channel is None or (self.topics is not None and channel[1].name not in self.topics):
                    continue
                key, topic = channel
                try:
                    message = decode(topic.message, record.data)
                except CodecError:
                    self.undecodable += 1
                    continue
                yield Entry(key, topic.name, message, record.log_time)

    def _records(self) -> Iterator[McapRecord]:
        try:
            for record in records_of(self.path):
                if not isinstance(record, Chunk):
                    yield record
                    continue
                try:
                    inside = breakup_chunk(record, validate_crc=True)
                except CORRUPT_DATA_ERRORS:
                    self.damaged_chunks += 1
                else:
                    yield from inside
        except CORRUPT_DATA_ERRORS:
            self.torn = True


def read_recording(path: Path, topics: Collection[str] | None = None) -> Reading:
    """The messages of a recording, of all topics or of some, to iterate over.

    Raises:
        RecordingError: there is no such file, or it is no recording.
    """
    with suppress(*CORRUPT_DATA_ERRORS):
        next(records_of(path))
    return Reading(path, topics)


@dataclass(frozen=True)
class RecordingMetadata:
    """What stands before the first message of a recording."""

    metadata: Mapping[str, str]
    attachments: Mapping[str, bytes]

    def speed_unit(self, tray: str) -> str:
        """The unit in which people are shown a tray's speeds: of the tray, of the whole recording, or rad/s."""
        return self.metadata.get(f"speed_unit.{tray}") or self.metadata.get("speed_unit", "rad/s")


def read_metadata(path: Path) -> RecordingMetadata:
    """The metadata and attachments of a recording.

    Raises:
        RecordingError: there is no such file, or it is no recording.
    """
    metadata: dict[str, str] = {}
    attachments: dict[str, bytes] = {}
    with suppress(*CORRUPT_DATA_ERRORS):
        for record in records_of(path):
            if isinstance(record, Metadata) and record.name == METADATA_NAME:
                metadata.update(record.metadata)
            elif isinstance(record, Attachment):
                attachments[record.name] = record.data
            elif isinstance(record, Chunk):
                break
    return RecordingMetadata(metadata, attachments)


CORRUPT_DATA_ERRORS = (McapError, ZstdError, ValueError, struct.error, OverflowError, MemoryError)
"""What reading bytes that are not what they should be raises; the last two where a damaged length asks for too much."""


def records_of(path: Path) -> Iterator[McapRecord]:
    """The records of a file, chunks as they are. Raises RecordingError at its beginning, or one of `BROKEN` later."""
    try:
        with path.open("rb") as file:
            if file.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
                raise RecordingError(f"{path}: not a recording (MCAP); make one of a table with `fantwin import`")
            file.seek(0)
            size = path.stat().st_size
            yield from StreamReader(file, emit_chunks=True, record_size_limit=size).records
    except OSError as error:
        raise RecordingError(f"{path}: cannot read the recording: {error.strerror}") from error


def _key_and_topic(channel: Channel) -> tuple[str, Topic] | None:
    try:
        return channel.topic, topic_of(channel.topic)
    except KeyError:
        return None  # somebody else's channel
