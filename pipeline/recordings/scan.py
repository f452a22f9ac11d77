"""Reading all of a file: what it contains, what is damaged, and what must be missing."""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from zlib import crc32

from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Header, Metadata, Schema
from mcap.writer import MCAP0_MAGIC

from fantwin.pipeline.recordings.reading import METADATA_NAME, left_out_of
from fantwin.pipeline.recordings.records import (
    CORRUPT_DATA_ERRORS,
    MESSAGE,
    Record,
    RecordingError,
    RecordReader,
    chunk_data,
    parse,
    records_in,
    summary_of,
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
    next_sequences,
    recovered_from_metadata,
)
from fantwin.schemas.health import Health
from fantwin.schemas.messages import ModelCard
from fantwin.schemas.streams import StreamId

TRUNCATED = "it is truncated, as after a crash"
NOT_A_RECORD = "bytes that belong to no intact record"
NO_INDEX = "it has no index"
STILL_WRITTEN = "it is still being written"
NO_LOSS = frozenset((NO_INDEX, STILL_WRITTEN))
"""the damage lines of a file that has lost nothing"""
_KINDS = {int(Opcode.CHUNK): "chunks", int(Opcode.ATTACHMENT): "attachments"}


@dataclass
class Contents:
    """The contents of one file, and what is wrong with it. Times are times of receipt."""

    path: Path
    reader: RecordReader
    profile: str = ""
    schemas: dict[int, Schema] = field(default_factory=dict[int, Schema])
    channels: dict[int, Channel] = field(default_factory=dict[int, Channel])
    messages: int = 0
    """intact ones, on channels of any origin"""
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
    damaged: Counter[str] = field(default_factory=Counter[str])
    """chunks, attachments and other records that are damaged"""
    nameless: int = 0
    """messages whose channel was described in a damaged chunk, and nowhere else"""
    discarded_bytes: int = 0
    """in records that are not whole"""
    damaged_offsets: set[int] = field(default_factory=set)
    """positions of the damaged chunks, attachments and other records"""
    data_end: int = len(MCAP0_MAGIC)
    """offset after the last intact record of the data"""

    is_being_written: bool = False
    """read up to its last flush"""

    @property
    def size_bytes(self) -> int:
        """Size of the file."""
        return self.reader.size

    @property
    def others(self) -> dict[str, int]:
        """Messages on channels that are not fantwin's, by topic."""
        return {topic: counts.messages for topic, counts in self.counts.others.items()}

    @property
    def sessions(self) -> list[Health]:
        """The last health of each session, in the order of the file."""
        return list(self.counts.sessions.values())

    @property
    def healths(self) -> list[Health]:
        """The last health of each stage and tray."""
        return list({(health.stage, health.instance): health for health in self.sessions}.values())

    @property
    def cards(self) -> Mapping[str, ModelCard]:
        """The last card of each twin, by key."""
        return self.counts.cards

    @property
    def next(self) -> dict[StreamId, int]:
        """The next expected sequence number of each stream after this file."""
        return next_sequences(self.before, self.streams)

    @property
    def damage(self) -> tuple[str, ...]:
        """What is wrong with the file, one line each."""
        if self.is_being_written:
            return (STILL_WRITTEN,)
        undecodable = self.counts.undecodable
        lines = (
            (not self.is_ended, TRUNCATED),
            (self.is_ended and not self.has_index, NO_INDEX),
            (self.discarded_bytes, f"{NOT_A_RECORD}: {self.discarded_bytes}"),
            *((count, f"damaged {kind}: {count}") for kind, count in self.damaged.items()),
            (
                self.lacking and not self.is_damaged,
                f"messages that its ledger counts and that are gone: {self.lacking}",
            ),
            (self.nameless, f"messages whose channel is damaged: {self.nameless}"),
            (undecodable, f"messages that do not have the type of their channel: {undecodable}"),
        )
        return tuple(line for is_so, line in lines if is_so)

    @property
    def is_damaged(self) -> bool:
        """Something in the middle cannot be read."""
        return bool(self.reader.damaged_ranges or self.damaged or self.nameless)

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
    def streams(self) -> dict[StreamId, StreamCounts]:
        """The counts of each stream: the ledger in the file, corrected for damage; without a ledger, as found."""
        found = self.counts.ledger.counts
        if self.recorded is None:
            return found
        return correct_for_damage(self.recorded, found) if self.is_damaged or self.lacking else self.recorded


def scan(path: Path) -> Contents:
    """What is in a file, by reading all of it.

    Raises:
        RecordingError: it cannot be read, or is not an MCAP file.
    """
    found = Contents(path, RecordReader(path, for_repair=True))
    try:
        footer: Record | None = None
        for record in found.reader:
            if found.is_ended:
                footer = record
            else:
                _add(found, record)
        found.has_index = footer is not None and found.reader.is_complete and _has_valid_summary(path, footer)
    except OSError as error:  # it was finished, and given its name, while it was read
        raise RecordingError(f"{path}: cannot read the recording: {error.strerror}; is it finished now?") from error
    reader = found.reader
    read_up_to = reader.size if found.is_ended else reader.end
    found.discarded_bytes += reader.size - read_up_to + sum(end - start for start, end in reader.damaged_ranges)
    return found


def _add(found: Contents, record: Record) -> None:
    """Add a record of the data section."""
    try:
        _add_intact(found, record)
    except CORRUPT_DATA_ERRORS:
        found.damaged[_KINDS.get(record.opcode, "records")] += 1
        found.damaged_offsets.add(record.offset)
        found.discarded_bytes += record.end - record.offset
    else:
        found.data_end = found.data_end if found.is_ended else record.end


def _add_intact(found: Contents, record: Record) -> None:
    match record.parsed:
        case Chunk() as chunk:
            _add_records(found, chunk_data(chunk))
        case Metadata(name=name, metadata=metadata):
            _add_metadata(found, name, metadata)
        case Attachment(name=name):
            found.attachments.append(name)
        case Header(profile=profile) if record.offset == len(MCAP0_MAGIC):
            found.profile = profile
        case Schema() | Channel():
            _add_records(found, record.data)
        case None if record.opcode == Opcode.MESSAGE:
            if MESSAGE.unpack_from(record.content)[0] not in found.channels:
                raise ValueError("a message without a channel")
            _add_records(found, record.data)
        case None if record.opcode == Opcode.MESSAGE_INDEX:
            pass
        case None if record.opcode == Opcode.DATA_END and len(record.content) == 4:
            found.is_ended = True
        case _:
            raise ValueError(f"a record of kind {record.opcode} in the data section, or a damaged one")


def _add_metadata(found: Contents, name: str, metadata: dict[str, str]) -> None:
    if name == LEDGER_NAME:
        found.recorded = counts_from_metadata(metadata)
        found.has_ended = ENDED in metadata
        found.recovered = recovered_from_metadata(metadata)
        found.is_ended = True
    elif name == METADATA_NAME:
        found.metadata.update(metadata)
        found.counts.ledger.left_out = left_out_of(metadata)
    elif name == BEFORE_NAME:
        found.before = before_from_metadata(metadata)
        found.counts.ledger = SequenceLedger(found.before, found.counts.ledger.left_out)


def _add_records(found: Contents, data: bytes) -> None:
    """Add the records of a chunk, or one that is in no chunk."""
    for _, opcode, start, end in records_in(data):
        if opcode == Opcode.SCHEMA:
            schema = parse(Schema, data[start:end])
            found.schemas[schema.id] = schema
        elif opcode == Opcode.CHANNEL:
            channel = parse(Channel, data[start:end])
            found.channels[channel.id] = channel
        elif opcode == Opcode.MESSAGE:
            number, _, received_t_ns, _ = MESSAGE.unpack_from(data, start)
            if number not in found.channels and not found.nameless:  # it was described in a damaged chunk
                summary = summary_of(found.path, for_repair=True)
                found.channels = summary.channels | found.channels
                found.schemas = summary.schemas | found.schemas
            if number not in found.channels:
                found.nameless += 1
                continue
            found.messages += 1
            found.first_ns = received_t_ns if found.first_ns is None else min(found.first_ns, received_t_ns)
            found.last_ns = received_t_ns if found.last_ns is None else max(found.last_ns, received_t_ns)
            found.counts.add(found.channels[number].topic, received_t_ns, data[start + MESSAGE.size : end])


def _has_valid_summary(path: Path, footer: Record) -> bool:
    start, _, crc = struct.unpack("<QQI", footer.content)
    if not start:
        return False
    with path.open("rb") as file:
        file.seek(start)
        summary = file.read(max(0, footer.end - 4 - start))
    return not crc or crc32(summary) == crc
