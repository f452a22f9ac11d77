"""Everything a file holds, found by going through all of it: what is there, what is damaged, what must be missing."""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from zlib import crc32

from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Attachment, Channel, Chunk, ChunkIndex, Header, Metadata, Schema
from mcap.summary import Summary
from mcap.writer import MCAP0_MAGIC

from pipeline.recordings.index import Index, message_indexes
from pipeline.recordings.message_counts import MessageCounts
from pipeline.recordings.reading import METADATA_NAME
from pipeline.recordings.records import (
    CORRUPT_DATA_ERRORS,
    MESSAGE,
    RECORD,
    Record,
    RecordReader,
    chunk_data,
    parse,
    record_bytes,
    records_in,
)
from pipeline.recordings.sequence_ledger import (
    BEFORE_NAME,
    ENDED,
    LEDGER_NAME,
    SequenceLedger,
    StreamCounts,
    StreamId,
    accounts_of,
    before_of,
    corrected,
    recovered_of,
)

Keep = Callable[[bytes], int]
"""Takes bytes that are to be kept of the file, in order; says where they stand in what is made of it."""


@dataclass
class Scan:
    """What was found in a file by `scan`."""

    path: Path
    walk: RecordReader
    index: Index = field(default_factory=Index)
    """of what was kept"""
    census: MessageCounts = field(default_factory=MessageCounts)
    """of the messages that were found"""
    recorded: dict[StreamId, StreamCounts] | None = None
    """the ledger that stands in the file, if it was finished"""
    before: dict[StreamId, int] = field(default_factory=dict)
    """with which number each producer should go on, by the parts before"""
    has_ended: bool = False
    """its recorder ended in order with this file, and not because something was in its way"""
    recovered: tuple[str, ...] = ()
    """what was said to be lost when it was mended before, one line each"""
    metadata: dict[str, str] = field(default_factory=dict)
    attachments: list[str] = field(default_factory=list)
    is_ended: bool = False
    """nothing was recorded after what is here: its recorder had come to the end"""
    has_index: bool = False
    damaged_chunks: int = 0
    damaged_attachments: int = 0
    damaged_records: int = 0
    """others"""
    nameless: int = 0
    """messages whose channel was described in a damaged chunk"""
    thrown_away_bytes: int = 0
    """of records that are not whole"""
    fits: bool = True
    """what is kept stands where it stood, up to `solid_end`; behind that there must be `tail`"""
    solid_end: int = len(MCAP0_MAGIC)
    tail: bytes = b""

    @property
    def is_damaged(self) -> bool:
        """Something in the middle cannot be read."""
        records = self.damaged_chunks + self.damaged_attachments + self.damaged_records
        return bool(self.walk.damaged_ranges or records or self.nameless)

    @property
    def is_whole(self) -> bool:
        """There is nothing to mend."""
        return self.walk.is_complete and self.has_index and not self.is_damaged

    @property
    def messages(self) -> int:
        """How many there are, whosever."""
        return self.index.messages.total()

    @property
    def accounts(self) -> dict[StreamId, StreamCounts]:
        """The ledger that was kept while it was written, if it is there, less what is damaged; or the one found."""
        found = self.census.ledger.accounts
        if self.recorded is None:
            return found
        return corrected(self.recorded, found) if self.is_damaged else self.recorded


def scan(path: Path, keep: Keep | None = None) -> Scan:
    """Go through a file.

    keep: is given what is to be kept of it behind the magic: whole records up to the end of the data, chunks with an
        index. Without it, places in `index` are as if all that is damaged had been cut out.

    Raises:
        RecordingError: it cannot be read, or is no MCAP file.
    """
    return _Scanner(path, keep).scan()


class _Scanner:
    def __init__(self, path: Path, keep: Keep | None) -> None:
        self._found = Scan(path, RecordReader(path))
        self._offset = len(MCAP0_MAGIC)
        self._keep = keep or self._pass_over
        self._late: Summary | None = None
        self._made_up: set[int] = set()
        self._has_begun = False
        self._past_data = False

    def _pass_over(self, data: bytes) -> int:
        before = self._offset
        self._offset += len(data)
        return before

    def scan(self) -> Scan:
        found, walk = self._found, self._found.walk
        footer: Record | None = None
        for record in walk:
            if not self._past_data:
                self._take(record)
            else:
                footer = record
        found.has_index = footer is not None and walk.is_complete and self._is_index_sound(footer)
        torn_at = walk.end if not self._past_data else walk.size
        found.thrown_away_bytes += walk.size - torn_at + sum(end - start for start, end in walk.damaged_ranges)
        return found

    def _take(self, record: Record) -> None:
        found = self._found
        try:
            self._take_kind(record)
        except CORRUPT_DATA_ERRORS:
            found.thrown_away_bytes += record.end - record.offset
            found.damaged_chunks += record.opcode == Opcode.CHUNK
            found.damaged_attachments += record.opcode == Opcode.ATTACHMENT
            found.damaged_records += record.opcode not in (Opcode.CHUNK, Opcode.ATTACHMENT)

    def _take_kind(self, record: Record) -> None:
        opcode, content = record.opcode, record.content
        if opcode == Opcode.CHUNK:
            self._take_chunk(record)
        elif opcode == Opcode.METADATA:
            self._take_metadata(record)
        elif opcode == Opcode.ATTACHMENT:
            self._take_attachment(record)
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            self._describe(opcode, content)
            self._keep_record(record)
        elif opcode == Opcode.HEADER and not self._has_begun:
            parse(Header, content)
            self._keep_record(record)
        elif opcode == Opcode.MESSAGE:
            self._take_loose(record)
        elif opcode == Opcode.DATA_END and len(content) == 4:
            self._found.is_ended = self._past_data = True
        elif opcode != Opcode.MESSAGE_INDEX or len(content) != 6 + struct.unpack_from("<HI", content)[1]:
            raise ValueError("no such record may stand here")  # indexes of messages may, and are made anew

    def _take_loose(self, record: Record) -> None:
        """A message outside of chunks, as others write them."""
        channel, sequence, log_time_ns, _ = MESSAGE.unpack_from(record.content)
        if not self._found.census.knows(channel):
            raise ValueError("a message of no channel")
        self._found.census.count(channel, sequence, log_time_ns, record.content, MESSAGE.size, len(record.content))
        self._found.index.note_loose(channel, log_time_ns)
        self._keep_record(record)

    def _keep_record(self, record: Record) -> int:
        if not self._has_begun and record.opcode != Opcode.HEADER:
            self._keep(record_bytes(Header(profile="", library="fantwin")))
        self._has_begun = True
        offset = self._keep(RECORD.pack(record.opcode, len(record.content)) + record.content)
        self._found.fits &= offset == record.offset
        self._found.solid_end, self._found.tail = offset + (record.end - record.offset), b""
        return offset

    def _take_metadata(self, record: Record) -> None:
        found, metadata = self._found, parse(Metadata, record.content)
        if metadata.name == LEDGER_NAME:
            found.recorded = accounts_of(metadata.metadata)
            found.has_ended = ENDED in metadata.metadata
            found.recovered = recovered_of(metadata.metadata)
            found.is_ended = self._past_data = True
            return
        if metadata.name == METADATA_NAME:
            found.metadata.update(metadata.metadata)
        elif metadata.name == BEFORE_NAME:
            found.before = before_of(metadata.metadata)
            found.census.ledger = SequenceLedger(found.before)
        found.index.note_metadata(metadata, self._keep_record(record), (record.end - record.offset))

    def _take_attachment(self, record: Record) -> None:
        attachment = parse(Attachment, record.content)
        crc = int.from_bytes(record.content[-4:], "little")
        if crc and crc != crc32(record.content[:-4]):
            raise ValueError("an attachment that is not what was written")
        self._found.attachments.append(attachment.name)
        self._found.index.note_attachment(attachment, self._keep_record(record), (record.end - record.offset))

    def _take_chunk(self, record: Record) -> None:
        assert isinstance(record.parsed, Chunk)
        chunk = record.parsed
        data = chunk_data(chunk)
        entries: dict[int, list[int]] = {}
        for offset, opcode, start, end in records_in(data):
            if opcode == Opcode.MESSAGE:
                channel, sequence, log_time_ns, _ = MESSAGE.unpack_from(data, start)
                flat = entries.get(channel)
                if flat is None:
                    flat = entries[channel] = []
                    self._require(channel)
                flat += (log_time_ns, offset)
                self._found.census.count(channel, sequence, log_time_ns, data, start + MESSAGE.size, end)
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                self._describe(opcode, data[start:end])
        self._found.nameless += sum(len(entries[channel]) // 2 for channel in entries.keys() & self._made_up)
        self._keep_chunk(record, chunk, entries)

    def _keep_chunk(self, record: Record, chunk: Chunk, entries: dict[int, list[int]]) -> None:
        offset = self._keep_record(record)
        indexes, offsets = message_indexes(entries, offset + (record.end - record.offset))
        self._keep(indexes)
        self._found.tail = indexes
        self._found.index.note_chunk(
            ChunkIndex(
                message_start_time=chunk.message_start_time,
                message_end_time=chunk.message_end_time,
                chunk_start_offset=offset,
                chunk_length=(record.end - record.offset),
                message_index_offsets=offsets,
                message_index_length=len(indexes),
                compression=chunk.compression,
                compressed_size=len(chunk.data),
                uncompressed_size=chunk.uncompressed_size,
            ),
            {channel: len(flat) // 2 for channel, flat in entries.items()},
        )

    def _describe(self, opcode: int, content: bytes) -> None:
        index = self._found.index
        if opcode == Opcode.SCHEMA:
            schema = parse(Schema, content)
            index.schemas[schema.id] = schema
            return
        channel = parse(Channel, content)
        index.channels[channel.id] = channel
        self._found.census.describe(channel.id, channel.topic)

    def _require(self, channel: int) -> None:
        if not self._found.census.knows(channel):
            self._describe_late(channel)

    def _describe_late(self, number: int) -> None:
        """A channel whose description was in a damaged chunk: as the summary has it, or else without a name."""
        self._late = self._late or summary_of(self._found.path)
        known = self._late.channels.get(number)
        if known is None:
            self._made_up.add(number)
        channel = known or Channel(number, f"lost/{number}", "", {}, 0)
        schema = self._late.schemas.get(channel.schema_id)
        self._keep(record_bytes(*([schema] if schema else []), channel))
        for each in (schema, channel):
            if each:
                self._describe(Opcode.SCHEMA if each is schema else Opcode.CHANNEL, record_bytes(each)[RECORD.size :])

    def _is_index_sound(self, footer: Record) -> bool:
        start, _, crc = struct.unpack("<QQI", footer.content)
        if not start:
            return False
        with self._found.path.open("rb") as file:
            file.seek(start)
            summary = file.read(max(0, footer.end - 4 - start))
        return not crc or crc32(summary) == crc


def summary_of(path: Path) -> Summary:
    """What stands behind the data of a file; an empty one where there is none, or none that can be read."""
    with path.open("rb") as file:
        try:
            return make_reader(file).get_summary() or Summary()
        except CORRUPT_DATA_ERRORS:
            return Summary()
