"""One list of damaged files, and what each reader says of every one; what files may make large is bounded."""

from __future__ import annotations

import os
import tracemalloc
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from zlib import crc32

import lz4.frame
import pytest
import zstandard
from mcap.opcode import Opcode
from mcap.records import Chunk, DataEnd, Footer, Header
from mcap.writer import MCAP0_MAGIC

from fantwin.pipeline.recordings.contents import contents_of
from fantwin.pipeline.recordings.indexed import last_messages, rare_messages
from fantwin.pipeline.recordings.reading import read_metadata, read_recording
from fantwin.pipeline.recordings.records import (
    LARGEST_CHUNK_BYTES,
    LARGEST_RECORD_BYTES,
    RECORD,
    Record,
    RecordReader,
    record_bytes,
)
from fantwin.pipeline.recordings.repair import recover
from fantwin.pipeline.recordings.scan import scan
from fantwin.pipeline.recordings.writing import RecordingWriter
from tests.support.written_recordings import ALARM_KEY, RAW_KEY, STREAM, alarm, raw, read_by_others

CHUNKS, IN_CHUNK, ALARM_IN = 10, 40, 4
"""chunks of raw messages, messages of each, and the chunk that has an alarm as well"""
ALL = CHUNKS * IN_CHUNK + 1


class File:
    """A whole recording, and the places in it."""

    def __init__(self, path: Path) -> None:
        self.content = bytearray(path.read_bytes())
        records = list(RecordReader(path))
        self.chunks = self.of(records, Opcode.CHUNK)
        self.indexes = self.of(records, Opcode.MESSAGE_INDEX)
        (self.attachment,), (self.data_end,) = self.of(records, Opcode.ATTACHMENT), self.of(records, Opcode.DATA_END)
        self.ledger = self.of(records, Opcode.METADATA)[-1]

    @staticmethod
    def of(records: list[Record], opcode: Opcode) -> list[Record]:
        return [record for record in records if record.opcode == opcode]

    def flip(self, at: int) -> bytes:
        self.content[at] ^= 0xFF
        return bytes(self.content)

    def zeros(self, start: int, size: int) -> bytes:
        self.content[start : start + size] = bytes(size)
        return bytes(self.content)

    def longer(self, record: Record, more: int) -> bytes:
        length = max(0, min(len(record.content) + more, (1 << 64) - 1))
        RECORD.pack_into(self.content, record.offset, record.opcode, length)
        return bytes(self.content)

    def with_empty_chunk(self) -> bytes:
        data = RECORD.pack(Opcode.MESSAGE, 1000) + bytes(50)
        chunk = record_bytes(Chunk("", data, 1, 1, crc32(data), len(data)))
        at = self.chunks[3].offset
        return bytes(self.content[:at] + chunk + self.content[at:])

    def to(self, offset: int) -> bytes:
        return bytes(self.content[:offset])

    def without_index(self) -> bytes:
        return self.to(self.data_end.offset) + record_bytes(DataEnd(0), Footer(0, 0, 0)) + MCAP0_MAGIC


@dataclass(frozen=True)
class Case:
    """A damage, and what is said of it.

    Attributes:
        lost: raw messages that no reader finds.
        read: what `Reading.damage` says after the file's name; "": nothing.
        found: lines of `fantwin recover`, in part.
    """

    damage: Callable[[File], bytes]
    lost: int = 0
    read: str = ""
    found: tuple[str, ...] = ()
    has_alarm: bool = True


ONE = "damaged chunks left out: 1"
CASES = {
    "a byte of a chunk": Case(lambda f: f.flip(f.chunks[3].end - 10), IN_CHUNK, ONE, ("damaged chunks: 1",)),
    "a byte of the chunk with the alarm": Case(
        lambda f: f.flip(f.chunks[ALARM_IN].end - 10), IN_CHUNK, ONE, ("damaged chunks: 1",), has_alarm=False
    ),
    **{
        f"length of a chunk {more:+}": Case(
            lambda f, more=more: f.longer(f.chunks[3], more), IN_CHUNK, ONE, ("bytes that belong to no intact record",)
        )
        for more in (1, -256, 1 << 16, 1 << 62)
    },
    **{
        f"length of a message index {more:+}": Case(
            lambda f, more=more: f.longer(f.indexes[3], more), 0, ONE, ("bytes that belong to no intact record",)
        )
        for more in (1, -256, 1 << 16)
    },
    "a sector of zeros over two chunks": Case(
        lambda f: f.zeros(f.chunks[2].end - 100, f.chunks[3].offset - f.chunks[2].end + 200),
        2 * IN_CHUNK,
        "damaged chunks left out: 2",
    ),
    "the chunk that describes a channel": Case(
        lambda f: f.flip(f.chunks[0].end - 10), IN_CHUNK, ONE, ("damaged chunks: 1",)
    ),
    "that chunk, and no end": Case(
        lambda f: f.flip(f.chunks[0].end - 10)[: f.ledger.offset],
        (CHUNKS * IN_CHUNK),
        f"it is truncated, as after a crash; read up to that point; {ONE}; messages left out whose channel is damaged: "
        f"{(CHUNKS - 1) * IN_CHUNK}",
        (f"messages whose channel is damaged: {(CHUNKS - 1) * IN_CHUNK}",),
    ),
    "an attachment": Case(lambda f: f.flip(f.attachment.offset + 60), 0, "", ("damaged attachments: 1",)),
    "a chunk without messages, of a right checksum": Case(
        File.with_empty_chunk, 0, "messages left out whose channel is damaged: 1", ("damaged chunks: 1",)
    ),
    "no end": Case(
        lambda f: f.to(f.ledger.offset), 0, "it is truncated, as after a crash; read up to that point", ("truncated",)
    ),
    "no end within a chunk": Case(
        lambda f: f.to(f.chunks[-1].end - 10),
        IN_CHUNK,
        "it is truncated, as after a crash; read up to that point",
        ("truncated", "bytes that belong to no intact record"),
    ),
    "no index": Case(File.without_index, 0, "", ("it has no index",)),
}


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("whole") / "r.mcap"
    with RecordingWriter(path, {"site": "plant"}, {"tray1.onnx": os.urandom(300)}) as writer:
        for sequence in range(CHUNKS * IN_CHUNK):
            writer.add_message(RAW_KEY, raw(sequence, samples=2), 1000 + sequence)
            if sequence == ALARM_IN * IN_CHUNK + 1:
                writer.add_message(ALARM_KEY, alarm(0), 1000 + sequence)
            if sequence % IN_CHUNK == IN_CHUNK - 1:
                writer.flush()
    return path


@pytest.mark.parametrize("name", CASES)
def test_a_damage_costs_what_it_touches_and_every_reader_says_so(name: str, whole: Path, tmp_path: Path) -> None:
    case, path = CASES[name], tmp_path / "r.mcap"
    path.write_bytes(case.damage(File(whole)))
    reading = read_recording(path)
    found = [each.message.header.sequence for each in reading if each.topic == "raw"]
    assert len(found) == CHUNKS * IN_CHUNK - case.lost and found == sorted(found)
    assert reading.damage == (f"{path}: {case.read}" if case.read else "")
    assert len(list(reading.undecoded())) == len(found) + case.has_alarm
    assert len(rare_messages(path, "alarm")) == len(last_messages(path, "alarm")) == case.has_alarm

    output = tmp_path / "out.mcap"
    before = path.read_bytes()
    lines = recover(path, output).found.damage
    assert path.read_bytes() == before
    assert all(any(part in line for line in lines) for part in case.found), lines
    by_others = read_by_others(output)
    assert len(by_others) == ALL - case.lost - (not case.has_alarm)
    assert scan(output).is_intact
    if not name.startswith(("no end within a chunk", "that chunk")):  # whose end no later message shows
        assert contents_of(output).streams[STREAM].missing == case.lost
    has_attachment = "damaged attachments: 1" not in lines
    assert bool(read_metadata(output).attachments) == has_attachment


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
