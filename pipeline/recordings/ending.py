"""The end of a file that its writer could not finish: ledger, index, footer. It needs little room and no copy."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from contextlib import suppress
from zlib import crc32

from mcap.opcode import Opcode
from mcap.records import DataEnd, Footer, Metadata, MetadataIndex, Statistics
from mcap.writer import MCAP0_MAGIC

from fantwin.pipeline.recordings.disk import AtomicAppendFile
from fantwin.pipeline.recordings.records import record_bytes
from fantwin.pipeline.recordings.scan import Scan
from fantwin.pipeline.recordings.sequence_ledger import LEDGER_NAME

_FOOTER = struct.Struct("<BQQQ")


def write_ending(file: AtomicAppendFile, found: Scan, ledger: Mapping[str, str]) -> None:
    """End a file after its last intact record, with an index of what was found in it.

    Raises:
        OSError: the disk refuses.
    """
    file.cut(found.data_end)
    metadata = record_bytes(Metadata(LEDGER_NAME, dict(ledger)))
    found.index.metadata_indexes.append(MetadataIndex(file.size, len(metadata), LEDGER_NAME))
    data = metadata + record_bytes(DataEnd(0))
    try:
        file.write(data + _summary(found, file.size + len(data)))
        file.sync()
    except OSError:
        found.index.metadata_indexes.pop()
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


def _summary(found: Scan, start: int) -> bytes:
    """The summary section of a file, at offset `start`, with footer and magic."""
    index = found.index
    statistics = Statistics(
        attachment_count=len(index.attachment_indexes),
        channel_count=len(index.channels),
        channel_message_counts=dict(found.written),
        chunk_count=len(index.chunk_indexes),
        message_count=found.messages,
        message_end_time=found.last_ns or 0,
        message_start_time=found.first_ns or 0,
        metadata_count=len(index.metadata_indexes),
        schema_count=len(index.schemas),
    )
    summary = record_bytes(
        *index.schemas.values(),
        *index.channels.values(),
        statistics,
        *index.chunk_indexes,
        *index.attachment_indexes,
        *index.metadata_indexes,
    )
    crc = crc32(_FOOTER.pack(Opcode.FOOTER, 20, start, 0), crc32(summary))
    return summary + record_bytes(Footer(start, 0, crc)) + MCAP0_MAGIC
