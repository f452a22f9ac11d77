"""The index of an MCAP file: what was put where, and the ending of the file made of it.

Kept while a file is written, and made anew of what a torn one still holds; an ending can so be written at any time.
"""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Iterable, Mapping
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

from pipeline.recordings.records import RECORD, record_bytes

SHORT_ENDING = record_bytes(DataEnd(0), Footer(0, 0, 0)) + MCAP0_MAGIC
"""Ends a file without a summary: forty bytes, where a summary may need thousands."""
_INDEX_HEAD = struct.Struct("<HI")
_FOOTER = struct.Struct("<BQQQ")


class Index:
    """What a file holds."""

    def __init__(self) -> None:
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.messages: Counter[int] = Counter()
        """by channel"""
        self.first_ns: int | None = None
        self.last_ns = 0
        self._chunks: list[McapRecord] = []
        self._attachments: list[McapRecord] = []
        self._metadata: list[McapRecord] = []

    def note_attachment(self, attachment: Attachment, offset: int, length: int) -> None:
        """An attachment stands at `offset` of the file, `length` bytes with all."""
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

    def note_metadata(self, metadata: Metadata, offset: int, length: int) -> None:
        """The same of metadata."""
        self._metadata.append(MetadataIndex(offset=offset, length=length, name=metadata.name))

    def forget_metadata(self) -> None:
        """The last metadata could not be written."""
        self._metadata.pop()

    def note_chunk(self, chunk: ChunkIndex, messages: Mapping[int, int]) -> None:
        """A chunk with so many messages of each channel."""
        self._chunks.append(chunk)
        self.messages.update(messages)
        self._note_times(chunk.message_start_time, chunk.message_end_time)

    def note_loose(self, channel: int, log_time_ns: int) -> None:
        """A message outside of chunks, as others write them."""
        self.messages[channel] += 1
        self._note_times(log_time_ns, log_time_ns)

    def ending(self, offset: int) -> bytes:
        """The end of the file, which begins at `offset`: end of data, summary, footer, magic."""
        data_end = record_bytes(DataEnd(0))
        start = offset + len(data_end)
        groups: tuple[tuple[Opcode, Iterable[McapRecord]], ...] = (
            (Opcode.SCHEMA, self.schemas.values()),
            (Opcode.CHANNEL, self.channels.values()),
            (Opcode.STATISTICS, [self._statistics()]),
            (Opcode.CHUNK_INDEX, self._chunks),
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

    def _note_times(self, first_ns: int, last_ns: int) -> None:
        self.first_ns = first_ns if self.first_ns is None else min(self.first_ns, first_ns)
        self.last_ns = max(self.last_ns, last_ns)

    def _statistics(self) -> Statistics:
        return Statistics(
            attachment_count=len(self._attachments),
            channel_count=len(self.channels),
            channel_message_counts=dict(self.messages),
            chunk_count=len(self._chunks),
            message_count=self.messages.total(),
            metadata_count=len(self._metadata),
            message_start_time=self.first_ns or 0,
            message_end_time=self.last_ns,
            schema_count=len(self.schemas),
        )


def message_indexes(entries: Mapping[int, list[int]], offset: int) -> tuple[bytes, dict[int, int]]:
    """The index records that follow a chunk, and where each channel's begins if they stand at `offset`.

    entries: by channel, log time and place in the chunk of each message, in turns.
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
