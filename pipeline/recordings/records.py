"""The records of an MCAP file in file order, damaged files included: the only place that reads MCAP byte by byte.

The `mcap` library parses each record and opens each chunk. Its own readers stop at the first damaged byte, which is why
finding the records is done here.
"""

from __future__ import annotations

import os
import re
import struct
from collections import deque
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from functools import cache
from importlib.metadata import version
from io import BytesIO
from itertools import islice
from pathlib import Path
from typing import BinaryIO, NamedTuple, TypeVar
from zlib import crc32

import lz4.frame
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import McapReader, SeekingReader
from mcap.records import Attachment, Channel, Chunk, ChunkIndex, Header, McapRecord, Metadata, Schema
from mcap.summary import Summary
from mcap.writer import MCAP0_MAGIC
from zstandard import ZstdDecompressor, ZstdError, frame_content_size

from fantwin.pipeline.errors import UserError
from fantwin.schemas.formats import RECORDING

METADATA_NAME = "fantwin"
"""the metadata record that describes a recording; it follows the header"""
FORMAT_KEY, MADE_BY_KEY = "format", "made_by"
"""keys of these metadata: the format number of the recording, and the program that wrote it"""
LARGEST_CHUNK_BYTES = 64 << 20
"""of a chunk without compression; a larger one is treated as damaged"""
LARGEST_RECORD_BYTES = 256 << 20
"""a longer record is treated as damaged: one record at a time is in memory"""
RECORD = struct.Struct("<BQ")
"""before each record's content: opcode, length of the content"""
MESSAGE = struct.Struct("<HIQQ")
"""before a message's payload: channel, sequence, log time, publish time"""
CORRUPT_DATA_ERRORS = (McapError, ZstdError, ValueError, struct.error, OverflowError, MemoryError)
"""What parsing damaged bytes raises; the last two where a damaged length asks for too much memory."""
SHOWN_CHARACTERS = 40
"""the most that an error message shows of a text from a file"""
_BEFORE_COMPRESSION = RECORD.size + 28  # of a chunk: start time, end time, size and checksum
_ZSTD = b"\x04\x00\x00\x00zstd"
_KNOWN = frozenset(int(opcode) for opcode in Opcode)
_PARSED: dict[int, type[McapRecord]] = {
    Opcode.HEADER: Header,
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel,
    Opcode.METADATA: Metadata,
    Opcode.ATTACHMENT: Attachment,
    Opcode.CHUNK: Chunk,
}
_FOOTER_BYTES = 20
_BLOCK_BYTES = 1 << 20

_Kind = TypeVar("_Kind", bound=McapRecord)


ACTIVE_SUFFIX = ".active"
"""follows the name of a file that is being written"""


class RecordingError(UserError):
    """A recording cannot be read or written. The message is one line."""


class UnreadableError(RecordingError):
    """The system refuses to read a file. It may allow it later."""


def active_path(path: Path) -> Path:
    """The name of a recording while it is being written."""
    return path.with_name(path.name + ACTIVE_SUFFIX)


class Record(NamedTuple):
    """One record of a file."""

    offset: int
    opcode: int
    content: bytes
    """without opcode and length"""
    parsed: McapRecord | None
    """a header, schema, channel, metadata, attachment or chunk; None for other records, and where it is damaged"""

    @property
    def data(self) -> bytes:
        """The whole record as in the file."""
        return RECORD.pack(self.opcode, len(self.content)) + self.content

    @property
    def end(self) -> int:
        """Offset of the byte after it."""
        return self.offset + RECORD.size + len(self.content)


@dataclass
class RecordReader:
    """The records of a file up to the footer, in file order; one at a time is in memory.

    After bytes that are no record, reading continues at the next intact chunk. The attributes below are final once the
    iteration has ended.
    """

    path: Path
    for_repair: bool = False
    """a description of the recording whose format number cannot be read is damaged, and no reason to stop"""
    is_complete: bool = field(default=False, init=False)
    """the file ends with a footer and the closing magic"""
    end: int = field(default=0, init=False)
    """offset after the last whole record, closing magic included"""
    size: int = field(default=0, init=False)
    damaged_ranges: list[tuple[int, int]] = field(default_factory=list, init=False)
    """offsets of bytes before `end` that are no records: first, and one past the last"""

    def __iter__(self) -> Iterator[Record]:
        """Raises RecordingError if the file cannot be read, is not an MCAP file, or is of an unknown format."""
        self.is_complete, self.end, self.damaged_ranges = False, len(MCAP0_MAGIC), []
        try:
            with self.path.open("rb") as file:
                if file.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
                    raise RecordingError(
                        f"{self.path}: not a recording (MCAP); make one from a table with `fantwin import`"
                    )
                self.size = file.seek(0, os.SEEK_END)
                file.seek(len(MCAP0_MAGIC))
                yield from self._records(file)
        except OSError as error:
            active = active_path(self.path)
            advice = f"; it is still being written: name {active}" if active.exists() else ""
            raise UnreadableError(f"{self.path}: cannot read the recording: {error.strerror}{advice}") from error

    def _records(self, file: BinaryIO) -> Iterator[Record]:
        while True:
            record = self._record(file)
            if record is None:
                resumed = self._next_chunk(file, self.end + 1)
                if resumed is None:
                    return
                self.damaged_ranges.append((self.end, resumed))
                self.end = resumed
                file.seek(resumed)
                continue
            self.end = record.end
            if self.for_repair and _is_without_number(record.parsed):
                record = record._replace(parsed=None)
            _check_format(record.parsed, self.path)
            yield record
            if record.opcode == Opcode.FOOTER and len(record.content) == _FOOTER_BYTES:
                self.is_complete = file.read(len(MCAP0_MAGIC)) == MCAP0_MAGIC and self.end + 8 == self.size
                self.end += len(MCAP0_MAGIC) if self.is_complete else 0
                return

    def _record(self, file: BinaryIO) -> Record | None:
        """The record at `self.end`; None if the bytes there are no record."""
        header = file.read(RECORD.size)
        if not self._is_plausible(header, self.end):
            return None
        opcode, length = RECORD.unpack(header)
        content = file.read(length)
        if len(content) < length:
            return None
        try:
            parsed = _parse_known(opcode, content)
        except CORRUPT_DATA_ERRORS:
            parsed = None
        else:
            if opcode in _KNOWN:
                return Record(self.end, opcode, content, parsed)
        if opcode in (Opcode.CHUNK, Opcode.MESSAGE_INDEX):
            return None  # a damaged length would skip whatever it spans, and the next chunk is easy to find
        following = file.read(RECORD.size)  # the length is trusted only if it leads to another record
        file.seek(self.end + RECORD.size + length)
        leads_on = self._is_plausible(following, self.end + RECORD.size + length) and following[0] in _KNOWN
        return Record(self.end, opcode, content, parsed) if leads_on else None

    def _is_plausible(self, header: bytes, offset: int) -> bool:
        """Whether these bytes can be the opcode and length of a record at `offset`."""
        is_whole = len(header) == RECORD.size and header[0] != 0
        return is_whole and RECORD.unpack(header)[1] <= min(self.size - offset - RECORD.size, LARGEST_RECORD_BYTES)

    def _next_chunk(self, file: BinaryIO, start: int) -> int | None:
        """Offset of the next intact zstd chunk at or after `start`; None if there is none."""
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
        if opcode != Opcode.CHUNK or length > min(self.size - offset - RECORD.size, LARGEST_RECORD_BYTES):
            return False
        try:
            chunk_data(parse(Chunk, file.read(length)))
        except CORRUPT_DATA_ERRORS:
            return False
        return True


def parse(kind: type[_Kind], content: bytes) -> _Kind:
    """A record (of any kind but Message) from its content. Raises one of CORRUPT_DATA_ERRORS."""
    record = kind.read(ReadDataStream(BytesIO(content)))  # type: ignore[attr-defined]  every kind but Message has it
    written = record_bytes(record)[RECORD.size :]
    has_no_checksum = kind is Attachment and content == written[:-4] + bytes(4)
    if content != written and not has_no_checksum:
        raise ValueError(f"these {len(content)} bytes are not a {kind.__name__} record, or its checksum is wrong")
    return record


def _parse_known(opcode: int, content: bytes) -> McapRecord | None:
    if opcode == Opcode.MESSAGE_INDEX:  # its entries are not needed, and parsing them is slow
        if struct.unpack_from("<I", content, 2)[0] != len(content) - 6:
            raise ValueError("a message index whose length is wrong")
        return None
    return parse(_PARSED[opcode], content) if opcode in _PARSED else None


def chunk_data(chunk: Chunk) -> bytes:
    """The uncompressed records of a chunk, at most LARGEST_CHUNK_BYTES.

    Raises one of CORRUPT_DATA_ERRORS where it is damaged or larger.
    """
    size = chunk.uncompressed_size
    if size > LARGEST_CHUNK_BYTES:
        raise ValueError(f"a chunk of {size} bytes; at most {LARGEST_CHUNK_BYTES}")
    data = _decompressed(chunk)
    if len(data) != size:
        raise ValueError(f"a chunk of {len(data)} bytes instead of {size}")
    if chunk.uncompressed_crc and crc32(data) != chunk.uncompressed_crc:
        raise ValueError("a chunk whose checksum is wrong")
    if not chunk.uncompressed_crc:
        deque(records_in(data), 0)  # without a checksum, at least the lengths must be right
    return data


def _decompressed(chunk: Chunk) -> bytes:
    """Never takes much more memory than the size that the chunk states: a few bytes can stand for gigabytes."""
    size = chunk.uncompressed_size
    if chunk.compression == "":
        return chunk.data
    if chunk.compression == "zstd":
        if frame_content_size(chunk.data) > size:  # -1 if the frame does not state it
            raise ValueError("a chunk whose compressed data state another size")
        return ZstdDecompressor().decompress(chunk.data, max_output_size=size)
    if chunk.compression == "lz4":
        try:
            return lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=size + 1)
        except RuntimeError as error:  # lz4 raises nothing more specific
            raise ValueError(str(error)) from error
    raise ValueError(f"unknown compression {chunk.compression!r}")


def check_format(path: Path, *, for_repair: bool = False) -> None:
    """Raises RecordingError: the file cannot be read, is not a recording, or is of an unknown format."""
    deque(islice(RecordReader(path, for_repair), 2), 0)  # header and metadata


def indexed_reader(file: BinaryIO) -> McapReader:
    """The library's reader of the index, for files from anywhere. It raises one of CORRUPT_DATA_ERRORS."""
    return SeekingReader(file, record_size_limit=LARGEST_RECORD_BYTES)


def summary_of(path: Path, *, for_repair: bool = False) -> Summary:
    """The summary section of a file; an empty one if it has none that can be read. Raises as `check_format`."""
    check_format(path, for_repair=for_repair)
    with path.open("rb") as file:
        try:
            return indexed_reader(file).get_summary() or Summary()
        except (LookupError, *CORRUPT_DATA_ERRORS):
            return Summary()


@cache
def this_program() -> str:
    """Name and version of this program, as the maker of a recording."""
    return f"fantwin {version('fantwin')}"


def _is_without_number(record: McapRecord | None) -> bool:
    if not isinstance(record, Metadata) or record.name != METADATA_NAME:
        return False
    return whole_number(record.metadata.get(FORMAT_KEY, "")) is None


def _check_format(record: McapRecord | None, path: Path | str) -> None:
    """Refuse the metadata of a recording of an unknown format, by a RecordingError."""
    if isinstance(record, Metadata) and record.name == METADATA_NAME:
        stated = record.metadata.get(FORMAT_KEY)
        number = None if stated is None else whole_number(stated)
        if refusal := RECORDING.refusal(stated[:SHOWN_CHARACTERS] if stated and number is None else number):
            made_by = record.metadata.get(MADE_BY_KEY, "an unknown program")[:SHOWN_CHARACTERS]
            raise RecordingError(f"{path}: {refusal} (made by {''.join(filter(str.isprintable, made_by))})")


def whole_number(text: str) -> int | None:
    """The number that a text of the metadata is; None if it is none that fantwin writes: at most 19 ASCII digits."""
    return int(text) if re.fullmatch(r"[0-9]{1,19}", text) else None


def chunk_at(file: BinaryIO, chunk: ChunkIndex) -> bytes:
    """`chunk_data` of the chunk that an index places there. Raises one of CORRUPT_DATA_ERRORS."""
    file.seek(chunk.chunk_start_offset)
    opcode, length = RECORD.unpack(file.read(RECORD.size))
    if opcode != Opcode.CHUNK or length > LARGEST_RECORD_BYTES:
        raise ValueError("an index with a chunk where none is")
    return chunk_data(parse(Chunk, file.read(length)))


def may_hold(chunk: ChunkIndex, channels: Collection[int]) -> bool:
    """Whether a chunk can have messages of these channels: an index need not say which it has."""
    return not chunk.message_index_offsets or not chunk.message_index_offsets.keys().isdisjoint(channels)


def records_in(data: bytes) -> Iterator[tuple[int, int, int, int]]:
    """Of each record in a chunk's data: offset, opcode, and where its content begins and ends.

    Raises one of CORRUPT_DATA_ERRORS.
    """
    at, size = 0, len(data)
    while at < size:
        opcode, length = RECORD.unpack_from(data, at)
        start = at + RECORD.size
        if not opcode or start + length > size:
            raise ValueError("a record without an opcode, or longer than its chunk")
        yield at, opcode, start, start + length
        at = start + length


def record_bytes(*records: McapRecord) -> bytes:
    """Records as they are written to a file."""
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return builder.end()
