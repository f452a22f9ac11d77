"""The end of a file that its writer cannot finish: ledger, index and footer. It needs little room and no copy."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from zlib import crc32

from mcap.opcode import Opcode
from mcap.records import Attachment, AttachmentIndex, DataEnd, Footer, Metadata, MetadataIndex, Statistics
from mcap.writer import MCAP0_MAGIC

from fantwin.pipeline.recordings.disk import AtomicAppendFile
from fantwin.pipeline.recordings.indexed import index_of
from fantwin.pipeline.recordings.records import RecordReader, record_bytes
from fantwin.pipeline.recordings.scan import Contents
from fantwin.pipeline.recordings.sequence_ledger import LEDGER_NAME

_FOOTER = struct.Struct("<BQQQ")
"""the footer up to its checksum, which covers that as well"""


def write_ending(path: Path, file: AtomicAppendFile, found: Contents, ledger: Mapping[str, str]) -> None:
    """End a file after its last intact record, with an index of what was found in it; without one where the disk has no
    room for it. file: of `path`.

    Raises:
        OSError: the disk refuses.
    """
    file.cut(found.data_end)
    try:
        file.write(record_bytes(Metadata(LEDGER_NAME, dict(ledger)), DataEnd(0)))
        file.write(_summary(path, found, file.size))
        file.sync()
    except OSError:
        file.cut(found.data_end)
        write_short_ending(file, ledger)


def write_short_ending(file: AtomicAppendFile, ledger: Mapping[str, str]) -> None:
    """End a file without an index, as far as the disk allows: readers read it in full."""
    end = record_bytes(DataEnd(0), Footer(0, 0, 0)) + MCAP0_MAGIC
    for data in (record_bytes(Metadata(LEDGER_NAME, dict(ledger))) + end, end, b""):
        with suppress(OSError):
            file.write(data)
            break
    with suppress(OSError):
        file.sync()


def _summary(path: Path, found: Contents, start: int) -> bytes:
    """The summary section of a file, at offset `start`, with footer and magic."""
    channels, chunks = index_of(path)
    attachments: list[AttachmentIndex] = []
    metadata: list[MetadataIndex] = []
    for record in RecordReader(path):
        length, parsed = record.end - record.offset, record.parsed
        if isinstance(parsed, Metadata):
            metadata.append(MetadataIndex(record.offset, length, parsed.name))
        elif isinstance(parsed, Attachment):
            times, names = (parsed.log_time, parsed.create_time), (parsed.name, parsed.media_type)
            attachments.append(AttachmentIndex(record.offset, length, *times, len(parsed.data), *names))
    statistics = Statistics(
        attachment_count=len(attachments),
        channel_count=len(channels),
        channel_message_counts={},
        chunk_count=len(chunks),
        message_count=found.messages,
        message_end_time=found.last_ns or 0,
        message_start_time=found.first_ns or 0,
        metadata_count=len(metadata),
        schema_count=len(found.schemas),
    )
    listed = (*found.schemas.values(), *channels.values(), statistics, *chunks, *attachments, *metadata)
    summary = record_bytes(*listed)
    checksum = crc32(_FOOTER.pack(Opcode.FOOTER, 20, start, 0), crc32(summary))
    return summary + record_bytes(Footer(start, 0, checksum)) + MCAP0_MAGIC
