"""Files from anywhere: what they can make large is bounded."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import lz4.frame
import pytest
import zstandard
from mcap.opcode import Opcode
from mcap.records import Chunk, Header
from mcap.writer import MCAP0_MAGIC

from fantwin.pipeline.recordings.contents import contents_of
from fantwin.pipeline.recordings.reading import read_recording
from fantwin.pipeline.recordings.records import (
    LARGEST_CHUNK_BYTES,
    LARGEST_RECORD_BYTES,
    RECORD,
    RecordReader,
    record_bytes,
)

BOMB = bytes(LARGEST_CHUNK_BYTES + (1 << 20))


def zstd(data: bytes) -> bytes:
    return zstandard.compress(data)


def zstd_without_size(data: bytes) -> bytes:
    stream = zstandard.ZstdCompressor().compressobj()
    return stream.compress(data) + stream.flush()


def chunk(compression: str, data: bytes, size: int) -> Chunk:
    return Chunk(
        compression=compression,
        data=data,
        message_end_time=1,
        message_start_time=1,
        uncompressed_crc=0,
        uncompressed_size=size,
    )


@pytest.mark.parametrize(
    ("compression", "compress", "size"),
    [("zstd", zstd, 1000), ("zstd", zstd_without_size, len(BOMB)), ("lz4", lz4.frame.compress, 1000)],
    ids=["zstd states little", "zstd without size states all", "lz4 states little"],
)
def test_row_17_a_chunk_that_expands_without_limit_is_not_expanded(tmp_path: Path, compression, compress, size):
    path = tmp_path / "bomb.mcap"
    content = record_bytes(Header(profile="", library=""), chunk(compression, compress(BOMB), size))
    path.write_bytes(MCAP0_MAGIC + content)
    tracemalloc.start()
    try:
        found = contents_of(path)
        envelopes = list(read_recording(path))
        _, peak_bytes = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak_bytes < 16 << 20
    assert (found.messages, envelopes) == (0, [])
    assert found.damage


def test_row_17_a_record_as_long_as_a_sparse_file_is_not_read(tmp_path: Path):
    path = tmp_path / "sparse.mcap"
    length = LARGEST_RECORD_BYTES + 1
    with path.open("wb") as file:
        file.write(MCAP0_MAGIC + RECORD.pack(Opcode.ATTACHMENT, length))
        file.truncate(length + 100)
    tracemalloc.start()
    try:
        assert list(RecordReader(path)) == []
        _, peak_bytes = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak_bytes < 16 << 20
