"""Reading all of a file: what it contains, what is damaged, and what must be missing."""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Collection
from dataclasses import dataclass, field
from pathlib import Path
from zlib import crc32

from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    Header,
    Metadata,
    MetadataIndex,
    Schema,
)
from mcap.summary import Summary
from mcap.writer import MCAP0_MAGIC

from fantwin.pipeline.recordings.reading import METADATA_NAME, left_out_of
from fantwin.pipeline.recordings.records import (
    CORRUPT_DATA_ERRORS,
    MESSAGE,
    Record,
    RecordingError,
    RecordReader,
    chunk_data,
    indexed_reader,
    parse,
    records_in,
)
from fantwin.pipeline.recordings.sequence_ledger import (
    BEFORE_NAME,
    ENDED,
    LEDGER_NAME,
    MessageCounts,
    SequenceLedger,
    StreamCounts,
    before_from_metadata,
    correct_for_damage,
    counts_from_metadata,
    recovered_from_metadata,
)
from fantwin.schemas.streams import StreamId


@dataclass
class Scan:
    """What was found in a file by `scan`."""

    path: Path
    reader: RecordReader
    profile: str = ""
    index: Summary = field(default_factory=Summary)
    """of what is intact, without statistics"""
    written: Counter[int] = field(default_factory=Counter[int])
    """intact messages by channel"""
    first_ns: int | None = None
    """first and last time of receipt; None without a message"""
    last_ns: int | None = None
    counts: MessageCounts = field(default_factory=MessageCounts)
    recorded: dict[StreamId, StreamCounts] | None = None
    """the ledger in the file; None if it was never finished"""
    before: dict[StreamId, int] = field(default_factory=dict)
    """the next expected sequence number of each stream at the start of the file, from the parts before it"""
    has_ended: bool = False
    """the recorder was stopped in order with this file, and not by an error"""
    recovered: tuple[str, ...] = ()
    """what an earlier repair reported as lost, one line each"""
    metadata: dict[str, str] = field(default_factory=dict)
    attachments: list[str] = field(default_factory=list)
    is_ended: bool = False
    """the data has its end: nothing was recorded after what is here"""
    has_index: bool = False
    damaged_chunks: int = 0
    damaged_attachments: int = 0
    damaged_records: int = 0
    """others"""
    nameless: int = 0
    """messages whose channel was described in a damaged chunk"""
    discarded_bytes: int = 0
    """in records that are not whole"""
    damaged_offsets: set[int] = field(default_factory=set)
    """positions of the damaged chunks, attachments and other records"""
    data_end: int = len(MCAP0_MAGIC)
    """offset after the last intact record of the data"""

    @property
    def is_damaged(self) -> bool:
        """Something in the middle cannot be read."""
        records = self.damaged_chunks + self.damaged_attachments + self.damaged_records
        return bool(self.reader.damaged_ranges or records or self.nameless)

    @property
    def is_intact(self) -> bool:
        """There is nothing to repair."""
        return self.reader.is_complete and self.has_index and not self.is_damaged and not self.lacking

    @property
    def lacking(self) -> int:
        """Messages that the ledger in the file counts and that are not in it: damaged, or removed afterwards."""
        found, recorded = self.counts.ledger.counts, self.recorded or {}
        return sum(
            max(0, counts.messages - found.get(stream, StreamCounts()).messages) for stream, counts in recorded.items()
        )

    @property
    def messages(self) -> int:
        """Number of messages, on channels of any origin."""
        return self.written.total()

    @property
    def streams(self) -> dict[StreamId, StreamCounts]:
        """The counts of each stream: the ledger in the file, corrected for damage; without a ledger, as found."""
        found = self.counts.ledger.counts
        if self.recorded is None:
            return found
        return correct_for_damage(self.recorded, found) if self.is_damaged or self.lacking else self.recorded


def scan(path: Path) -> Scan:
    """Go through a file.

    Raises:
        RecordingError: it cannot be read, or is not an MCAP file.
    """
    found = Scan(path, RecordReader(path, for_repair=True))
    try:
        footer = _read_to_footer(found)
        found.has_index = footer is not None and found.reader.is_complete and _has_valid_summary(path, footer)
    except OSError as error:  # it was finished, and given its name, while it was read
        raise RecordingError(f"{path}: cannot read the recording: {error.strerror}; is it finished now?") from error
    reader = found.reader
    read_up_to = reader.size if found.is_ended else reader.end
    found.discarded_bytes += reader.size - read_up_to + sum(end - start for start, end in reader.damaged_ranges)
    return found


def _read_to_footer(found: Scan) -> Record | None:
    scanner = _Scanner(found)
    footer: Record | None = None
    for record in found.reader:
        if found.is_ended:
            footer = record
        else:
            scanner.add(record)
    scanner.end_chunk()
    return footer


class _Scanner:
    """Adds the records of the data section to a Scan."""

    def __init__(self, found: Scan) -> None:
        self._found = found
        self._summary: Summary | None = None
        self._nameless: set[int] = set()
        self._channels: Collection[int] = ()
        """of the last chunk"""

    def add(self, record: Record) -> None:
        found = self._found
        try:
            self._add(record)
        except CORRUPT_DATA_ERRORS:
            found.damaged_offsets.add(record.offset)
            found.discarded_bytes += record.end - record.offset
            found.damaged_chunks += record.opcode == Opcode.CHUNK
            found.damaged_attachments += record.opcode == Opcode.ATTACHMENT
            found.damaged_records += record.opcode not in (Opcode.CHUNK, Opcode.ATTACHMENT)

    def _add(self, record: Record) -> None:
        found, index, length = self._found, self._found.index, record.end - record.offset
        match record.parsed:
            case Chunk() as chunk:
                self._add_chunk(record, chunk)
            case Metadata(name=name, metadata=metadata) if name == LEDGER_NAME:
                found.recorded = counts_from_metadata(metadata)
                found.has_ended = ENDED in metadata
                found.recovered = recovered_from_metadata(metadata)
                found.is_ended = True
                return
            case Metadata() as metadata:
                self._add_metadata(metadata)
                index.metadata_indexes.append(MetadataIndex(record.offset, length, metadata.name))
            case Attachment() as a:
                found.attachments.append(a.name)
                index.attachment_indexes.append(
                    AttachmentIndex(record.offset, length, a.log_time, a.create_time, len(a.data), a.name, a.media_type)
                )
            case Schema() | Channel() as description:
                self._describe(description)
            case Header(profile=profile) if record.offset == len(MCAP0_MAGIC):
                found.profile = profile
            case None if record.opcode == Opcode.MESSAGE:
                self._add_unchunked(record)
            case None if record.opcode == Opcode.MESSAGE_INDEX and index.chunk_indexes:
                chunk_index = index.chunk_indexes[-1]
                (channel,) = struct.unpack_from("<H", record.content)
                chunk_index.message_index_offsets[channel] = record.offset
                chunk_index.message_index_length += length
            case None if record.opcode == Opcode.MESSAGE_INDEX:
                pass
            case None if record.opcode == Opcode.DATA_END and len(record.content) == 4:
                found.is_ended = True
                return
            case _:
                raise ValueError(f"a record of kind {record.opcode} in the data section, or a damaged one")
        found.data_end = record.end

    def _add_metadata(self, metadata: Metadata) -> None:
        found = self._found
        if metadata.name == METADATA_NAME:
            found.metadata.update(metadata.metadata)
            found.counts.ledger.left_out = left_out_of(metadata.metadata)
        elif metadata.name == BEFORE_NAME:
            found.before = before_from_metadata(metadata.metadata)
            found.counts.ledger = SequenceLedger(found.before, found.counts.ledger.left_out)

    def _add_unchunked(self, record: Record) -> None:
        """A message outside of chunks, as other writers may write them."""
        channel, _, received_t_ns, _ = MESSAGE.unpack_from(record.content)
        if channel not in self._found.index.channels:
            raise ValueError("a message without a channel")
        key = self._found.index.channels[channel].topic
        self._found.counts.add(key, received_t_ns, record.content[MESSAGE.size :])
        self._found.written[channel] += 1
        self._add_times(received_t_ns, received_t_ns)

    def _add_chunk(self, record: Record, chunk: Chunk) -> None:
        found, channels, data = self._found, self._found.index.channels, chunk_data(chunk)
        self.end_chunk()
        written: Counter[int] = Counter()
        for _, opcode, start, end in records_in(data):
            if opcode == Opcode.MESSAGE:
                channel, _, received_t_ns, _ = MESSAGE.unpack_from(data, start)
                if channel not in channels:
                    self._describe_from_summary(channel)
                written[channel] += 1
                found.counts.add(channels[channel].topic, received_t_ns, data[start + MESSAGE.size : end])
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                self._describe(parse(Schema if opcode == Opcode.SCHEMA else Channel, data[start:end]))
        found.nameless += sum(written[channel] for channel in written.keys() & self._nameless)
        found.written.update(written)
        self._channels = written.keys()
        if written:
            self._add_times(chunk.message_start_time, chunk.message_end_time)
        found.index.chunk_indexes.append(
            ChunkIndex(
                message_start_time=chunk.message_start_time,
                message_end_time=chunk.message_end_time,
                chunk_start_offset=record.offset,
                chunk_length=record.end - record.offset,
                message_index_offsets={},
                message_index_length=0,
                compression=chunk.compression,
                compressed_size=len(chunk.data),
                uncompressed_size=chunk.uncompressed_size,
            )
        )

    def end_chunk(self) -> None:
        """Forget the message indexes of the last chunk if some are missing: a reader then looks for each channel."""
        for last in self._found.index.chunk_indexes[-1:]:
            if last.message_index_offsets.keys() != self._channels:
                last.message_index_offsets, last.message_index_length = {}, 0

    def _add_times(self, first_ns: int, last_ns: int) -> None:
        found = self._found
        found.first_ns = first_ns if found.first_ns is None else min(found.first_ns, first_ns)
        found.last_ns = last_ns if found.last_ns is None else max(found.last_ns, last_ns)

    def _describe(self, description: Schema | Channel) -> None:
        if isinstance(description, Schema):
            self._found.index.schemas[description.id] = description
        else:
            self._found.index.channels[description.id] = description

    def _describe_from_summary(self, number: int) -> None:
        """A channel that was described in a damaged chunk: taken from the summary, or else left without a name."""
        self._summary = self._summary or summary_of(self._found.path)
        channel = self._summary.channels.get(number)
        if channel is None:
            self._nameless.add(number)
            channel = Channel(number, f"lost/{number}", "", {}, 0)
        elif channel.schema_id in self._summary.schemas:
            self._describe(self._summary.schemas[channel.schema_id])
        self._describe(channel)


def _has_valid_summary(path: Path, footer: Record) -> bool:
    start, _, crc = struct.unpack("<QQI", footer.content)
    if not start:
        return False
    with path.open("rb") as file:
        file.seek(start)
        summary = file.read(max(0, footer.end - 4 - start))
    return not crc or crc32(summary) == crc


def summary_of(path: Path) -> Summary:
    """The summary section of a file; an empty one if it has none that can be read."""
    with path.open("rb") as file:
        try:
            return indexed_reader(file).get_summary() or Summary()
        except CORRUPT_DATA_ERRORS:
            return Summary()
