"""The records of an MCAP file as they lie in it, as far as they are whole, and past what is damaged."""

from __future__ import annotations

import os
import struct
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, NamedTuple, TypeVar
from zlib import crc32

from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Header, McapRecord, Metadata, Schema
from mcap.stream_reader import get_chunk_data_stream
from mcap.writer import MCAP0_MAGIC
from zstandard import ZstdDecompressor

from pipeline.recordings.reading import CORRUPT_DATA_ERRORS, RecordingError

RECORD = struct.Struct("<BQ")
"""before each record: opcode, length"""
MESSAGE = struct.Struct("<HIQQ")
"""before a message's bytes: channel, sequence, log time, publish time"""
_CHUNK = struct.Struct("<QQQI")
_BEFORE_COMPRESSION = RECORD.size + _CHUNK.size
_ZSTD = b"\x04\x00\x00\x00zstd"
_KNOWN = frozenset(int(opcode) for opcode in Opcode)
_DESCRIBING: dict[int, type[McapRecord]] = {
    Opcode.HEADER: Header,
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel,
    Opcode.METADATA: Metadata,
    Opcode.ATTACHMENT: Attachment,
}
_FOOTER_BYTES = 20
_BLOCK_BYTES = 1 << 20

_Record = TypeVar("_Record", bound=McapRecord)


class Found(NamedTuple):
    """A whole record: where it begins, and what stands after its opcode and length."""

    offset: int
    opcode: int
    content: bytes

    @property
    def length(self) -> int:
        """Of all of it in the file."""
        return RECORD.size + len(self.content)

    @property
    def end(self) -> int:
        """Where the next one begins."""
        return self.offset + self.length


class ChunkContent(NamedTuple):
    """A chunk, opened and found to be whole."""

    first_ns: int
    last_ns: int
    data: bytes
    """its records, uncompressed"""
    compression: str
    compressed_bytes: int


class LooseMessage(NamedTuple):
    """A message record."""

    offset: int
    channel: int
    sequence: int
    log_time_ns: int
    publish_time_ns: int
    payload: bytes


@dataclass
class RecordReader:
    """All records of a file up to the footer, in order; one is in memory at a time.

    Where what follows cannot be one, the walk goes on at the next whole chunk, if there is one. Once it is through:
    """

    path: Path
    is_complete: bool = field(default=False, init=False)
    """the file ends as it should, with footer and magic"""
    end: int = field(default=0, init=False)
    """where the last whole record ends, that closing magic included"""
    size: int = field(default=0, init=False)
    damaged: list[tuple[int, int]] = field(default_factory=list, init=False)
    """stretches before `end` that are no records"""

    def __iter__(self) -> Iterator[Found]:
        """Raises RecordingError: the file cannot be read, or is no MCAP file."""
        self.is_complete, self.end, self.damaged = False, len(MCAP0_MAGIC), []
        try:
            with self.path.open("rb") as file:
                if file.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
                    raise RecordingError(f"{self.path}: not a recording (MCAP)")
                self.size = os.fstat(file.fileno()).st_size
                yield from self._records(file)
        except OSError as error:
            raise RecordingError(f"{self.path}: cannot read the recording: {error.strerror}") from error

    def _records(self, file: BinaryIO) -> Iterator[Found]:
        while True:
            found = self._record(file)
            if found is None:
                resumed = self._next_chunk(file, self.end + 1)
                if resumed is None:
                    return
                self.damaged.append((self.end, resumed))
                self.end = resumed
                file.seek(resumed)
                continue
            self.end = found.end
            yield found
            if found.opcode == Opcode.FOOTER and len(found.content) == _FOOTER_BYTES:
                self.is_complete = file.read(len(MCAP0_MAGIC)) == MCAP0_MAGIC and self.end + 8 == self.size
                self.end += len(MCAP0_MAGIC) if self.is_complete else 0
                return

    def _record(self, file: BinaryIO) -> Found | None:
        head = file.read(RECORD.size)
        if not self._is_plausible(head, self.end):
            return None
        opcode, length = RECORD.unpack(head)
        content = file.read(length)
        if len(content) < length:
            return None
        found = Found(self.end, opcode, content)
        if opcode in _KNOWN and _is_of_its_length(opcode, content):
            return found
        if opcode in (Opcode.CHUNK, Opcode.MESSAGE_INDEX):
            return None  # a damaged length would cost all that it spans, and the next chunk is easily found
        following = file.read(RECORD.size)  # the length is not trusted unless it leads to another record
        file.seek(found.end)
        return found if self._is_plausible(following, found.end) and following[0] in _KNOWN else None

    def _is_plausible(self, head: bytes, offset: int) -> bool:
        return len(head) == RECORD.size and head[0] != 0 and RECORD.unpack(head)[1] <= self.size - offset - RECORD.size

    def _next_chunk(self, file: BinaryIO, start: int) -> int | None:
        """Where the next whole chunk of our own kind begins, from `start` on."""
        at, window = start, b""
        file.seek(start)
        while block := file.read(_BLOCK_BYTES):
            window += block
            found = window.find(_ZSTD)
            while found != -1:
                offset = at + found - _BEFORE_COMPRESSION
                if offset >= start and self._is_chunk(file, offset):
                    return offset
                found = window.find(_ZSTD, found + 1)
            keep = len(_ZSTD) - 1
            at += len(window) - keep
            window = window[-keep:]
            file.seek(at + keep)
        return None

    def _is_chunk(self, file: BinaryIO, offset: int) -> bool:
        file.seek(offset)
        opcode, length = RECORD.unpack(file.read(RECORD.size))
        if opcode != Opcode.CHUNK or length > self.size - offset - RECORD.size:
            return False
        try:
            open_chunk(file.read(length))
        except CORRUPT_DATA_ERRORS:
            return False
        return True


def _is_of_its_length(opcode: int, content: bytes) -> bool:
    """Whether the lengths inside a record agree with its own, where it has any inside."""
    try:
        if opcode == Opcode.CHUNK:
            _, at = _text(content, _CHUNK.size)
            return struct.unpack_from("<Q", content, at)[0] == len(content) - at - 8
        if opcode == Opcode.MESSAGE_INDEX:
            return struct.unpack_from("<I", content, 2)[0] == len(content) - 6
        if opcode in _DESCRIBING:
            parse(_DESCRIBING[opcode], content)
    except CORRUPT_DATA_ERRORS:
        return False
    return True


def open_chunk(content: bytes) -> ChunkContent:
    """Open a chunk record. Raises one of `BROKEN` where it is damaged."""
    first_ns, last_ns, size, crc = _CHUNK.unpack_from(content)
    compression, at = _text(content, _CHUNK.size)
    (length,) = struct.unpack_from("<Q", content, at)
    packed = content[at + 8 :]
    if length != len(packed):
        raise ValueError("a chunk of another length than it says")
    if compression == "zstd":
        data = ZstdDecompressor().decompress(packed, max_output_size=size)
    elif not compression:
        data = packed
    elif compression == "lz4":
        data = _by_the_library(content)
    else:
        raise ValueError(f"compressed with {compression!r}")
    if len(data) != size or (crc and crc32(data) != crc):
        raise ValueError("a chunk that is not what was written")
    chunk = ChunkContent(first_ns, last_ns, data, compression, len(packed))
    if not crc:
        deque(records_in(chunk), 0)  # what has no checksum must have a form at least
    return chunk


def _by_the_library(content: bytes) -> bytes:
    try:
        stream, size = get_chunk_data_stream(parse(Chunk, content))
    except RuntimeError as error:  # of lz4, which knows no other
        raise ValueError(str(error)) from error
    return stream.read(size)


def records_in(chunk: ChunkContent) -> Iterator[tuple[int, int, int, int]]:
    """Offset, opcode, and where the content begins and ends, of each record of a chunk. Raises one of `BROKEN`."""
    at, size = 0, len(chunk.data)
    while at < size:
        opcode, length = RECORD.unpack_from(chunk.data, at)
        start = at + RECORD.size
        if start + length > size:
            raise ValueError("a record that is longer than its chunk")
        yield at, opcode, start, start + length
        at = start + length


def message_of(content: bytes) -> LooseMessage:
    """A message from a record's content. Raises one of `BROKEN`."""
    channel, sequence, log_time_ns, publish_time_ns = MESSAGE.unpack_from(content)
    return LooseMessage(0, channel, sequence, log_time_ns, publish_time_ns, content[MESSAGE.size :])


def payloads_of(chunk: ChunkContent, channel: int) -> list[bytes]:
    """The payloads of a channel's messages in a chunk. Raises one of `BROKEN`."""
    return [
        chunk.data[start + MESSAGE.size : end]
        for _, opcode, start, end in records_in(chunk)
        if opcode == Opcode.MESSAGE and MESSAGE.unpack_from(chunk.data, start)[0] == channel
    ]


def parse(kind: type[_Record], content: bytes) -> _Record:
    """A record from its content; not for messages. Raises one of `BROKEN`."""
    record = kind.read(ReadDataStream(BytesIO(content)))  # type: ignore[attr-defined]  all but messages have it
    if len(record_bytes(record)) != RECORD.size + len(content):
        raise ValueError(f"what says it is {kind.__name__} is something else")
    return record


def record_bytes(*records: McapRecord) -> bytes:
    """Records as they stand in a file."""
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return builder.end()


def _text(content: bytes, at: int) -> tuple[str, int]:
    (length,) = struct.unpack_from("<I", content, at)
    end = at + 4 + length
    return content[at + 4 : end].decode(), end
