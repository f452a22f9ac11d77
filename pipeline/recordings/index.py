"""The index of an MCAP file: where each chunk, channel and attachment is, and the end of the file that contains it.

It is kept while a file is written, and rebuilt from a truncated file. The end can be written at any time and lists only
what is on the disk; the Writer of the `mcap` library also counts messages whose chunk the disk refused.
"""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from zlib import crc32

from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    ChunkIndex,
    DataEnd,
    Footer,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.writer import MCAP0_MAGIC

from fantwin.pipeline.recordings.disk import AtomicAppendFile
from fantwin.pipeline.recordings.records import RECORD, record_bytes
from fantwin.pipeline.recordings.sequence_ledger import LEDGER_NAME

SHORT_ENDING = record_bytes(DataEnd(0), Footer(0, 0, 0)) + MCAP0_MAGIC
"""The end of a file without a summary: 40 bytes, where a summary may need thousands."""
_INDEX_HEAD = struct.Struct("<HI")
_FOOTER = struct.Struct("<BQQQ")


@dataclass(frozen=True)
class PartIndex:
    """Where the chunks of a file are."""

    path: Path
    channels: Mapping[int, Channel]
    chunks: Sequence[ChunkIndex]


class Index:
    """What a file holds, and where."""

    def __init__(self) -> None:
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.messages: Counter[int] = Counter()
        """by channel"""
        self.first_ns: int | None = None
        self.last_ns = 0
        self.chunks: list[ChunkIndex] = []
        self._attachments: list[McapRecord] = []
        self._metadata: list[McapRecord] = []

    def add_attachment(self, attachment: Attachment, offset: int, length: int) -> None:
        """Add an attachment whose record is at `offset` and has `length` bytes."""
        self._attachments.append(
            AttachmentIndex(
                offset=offset,
                length=length,
                log_time=attachment.log_time,
                create_time=attachment.create_time,
                data_size=len(attachment.data),
                name=attachment.name,
                media_type=attachment.media_type,
            )
        )

    def add_metadata(self, metadata: Metadata, offset: int, length: int) -> None:
        """Add a metadata record at `offset` of `length` bytes."""
        self._metadata.append(MetadataIndex(offset=offset, length=length, name=metadata.name))

    def remove_last_metadata(self) -> None:
        """Remove the last metadata, which could not be written."""
        self._metadata.pop()

    def add_chunk(self, chunk: ChunkIndex, messages: Mapping[int, int]) -> None:
        """Add a chunk; messages: how many it has of each channel."""
        self.chunks.append(chunk)
        self.messages.update(messages)
        self._add_times(chunk.message_start_time, chunk.message_end_time)

    def add_unchunked_message(self, channel: int, log_time_ns: int) -> None:
        """Add a message outside of chunks, as other writers may write them."""
        self.messages[channel] += 1
        self._add_times(log_time_ns, log_time_ns)

    def ending(self, offset: int) -> bytes:
        """The end of a file whose data ends at `offset`: end of data, summary, footer, magic."""
        data_end = record_bytes(DataEnd(0))
        start = offset + len(data_end)
        groups: tuple[tuple[Opcode, Iterable[McapRecord]], ...] = (
            (Opcode.SCHEMA, self.schemas.values()),
            (Opcode.CHANNEL, self.channels.values()),
            (Opcode.STATISTICS, [self._statistics()]),
            (Opcode.CHUNK_INDEX, self.chunks),
            (Opcode.ATTACHMENT_INDEX, self._attachments),
            (Opcode.METADATA_INDEX, self._metadata),
        )
        summary = b""
        offsets: list[McapRecord] = []
        for opcode, records in groups:
            group = record_bytes(*records)
            if group:
                offsets.append(SummaryOffset(opcode, start + len(summary), len(group)))
            summary += group
        offset_start = start + len(summary)
        summary += record_bytes(*offsets)
        crc = crc32(_FOOTER.pack(Opcode.FOOTER, 20, start, offset_start), crc32(summary))
        return data_end + summary + record_bytes(Footer(start, offset_start, crc)) + MCAP0_MAGIC

    def _add_times(self, first_ns: int, last_ns: int) -> None:
        self.first_ns = first_ns if self.first_ns is None else min(self.first_ns, first_ns)
        self.last_ns = max(self.last_ns, last_ns)

    def _statistics(self) -> Statistics:
        return Statistics(
            attachment_count=len(self._attachments),
            channel_count=len(self.channels),
            channel_message_counts=dict(self.messages),
            chunk_count=len(self.chunks),
            message_count=self.messages.total(),
            metadata_count=len(self._metadata),
            message_start_time=self.first_ns or 0,
            message_end_time=self.last_ns,
            schema_count=len(self.schemas),
        )


def message_indexes(entries: Mapping[int, list[int]], offset: int) -> tuple[bytes, dict[int, int]]:
    """The message index records of a chunk that start at `offset`, and the offset of each channel's record.

    entries: by channel, log time and offset in the chunk of each message, alternating.
    """
    parts: list[bytes] = []
    offsets: dict[int, int] = {}
    for channel, flat in entries.items():
        size = 8 * len(flat)
        offsets[channel] = offset
        parts += (
            RECORD.pack(Opcode.MESSAGE_INDEX, _INDEX_HEAD.size + size),
            _INDEX_HEAD.pack(channel, size),
            struct.pack(f"<{len(flat)}Q", *flat),
        )
        offset += RECORD.size + _INDEX_HEAD.size + size
    return b"".join(parts), offsets


def write_ending(
    file: AtomicAppendFile,
    index: Index,
    ledger: Mapping[str, str],
    *,
    before: bytes = b"",
) -> None:
    """End a file with `before`, the ledger and the index: all of it, or nothing.

    Raises:
        OSError: the disk refuses.
    """
    metadata = Metadata(name=LEDGER_NAME, metadata=dict(ledger))
    record = record_bytes(metadata)
    size, offset = file.size, file.size + len(before)
    index.add_metadata(metadata, offset, len(record))
    try:
        file.write(before + record + index.ending(offset + len(record)))
        file.sync()
    except OSError:
        index.remove_last_metadata()
        file.cut(size)
        raise
