"""The chunks of the parts of a recording, found by their index: also of the part that is being written."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property
from pathlib import Path

from mcap.records import ChunkIndex

from fantwin.pipeline.recordings.index import PartIndex
from fantwin.pipeline.recordings.parts import part_files
from fantwin.pipeline.recordings.reading import Reading, RecordingMetadata, read_metadata
from fantwin.pipeline.recordings.records import (
    ACTIVE_SUFFIX,
    CORRUPT_DATA_ERRORS,
    RecordingError,
    chunk_at,
    indexed_reader,
)
from fantwin.pipeline.recordings.run_recordings import RECORDING_KEY
from fantwin.pipeline.recordings.scan import scan
from fantwin.schemas.envelope import Envelope


class PartChunks:
    """The chunks of one part."""

    def __init__(self, index: PartIndex) -> None:
        self._path = index.path
        self.chunks = sorted(index.chunks, key=lambda chunk: chunk.chunk_start_offset)
        self.first_ns = min((chunk.message_start_time for chunk in self.chunks), default=0)
        self.last_ns = max((chunk.message_end_time for chunk in self.chunks), default=0)
        self._reading = Reading(index.path, None, None)
        self._channels: dict[int, tuple[str, str]] = {}
        for channel in index.channels.values():
            self._reading.add_channel(channel, self._channels)

    @cached_property
    def metadata(self) -> RecordingMetadata:
        """Metadata and attachments. Raises RecordingError, OSError."""
        return read_metadata(self._file)

    @property
    def site(self) -> str:
        """The name of the site; empty if there is no message."""
        return next((key.split("/")[1] for key, _ in self._channels.values()), "")

    def channels_of(self, key: str) -> set[int]:
        """The numbers of the channels of a key."""
        return {number for number, (name, _) in self._channels.items() if name == key}

    def envelopes(self, chunk: ChunkIndex) -> list[Envelope]:
        """The messages of a chunk, as bytes.

        Raises:
            OSError: the file is gone.
            one of CORRUPT_DATA_ERRORS: the chunk is damaged.
        """
        with self._file.open("rb") as file:
            data = chunk_at(file, chunk.chunk_start_offset, chunk.chunk_length)
        return self._reading.envelopes_in(data, self._channels)

    @property
    def _file(self) -> Path:
        """The file, which may have been finished since."""
        if self._path.name.endswith(ACTIVE_SUFFIX) and not self._path.exists():
            return self._path.with_name(self._path.name.removesuffix(ACTIVE_SUFFIX))
        return self._path


def parts_backwards(recording: Path, open_part: PartIndex | None) -> Iterator[PartChunks]:
    """The parts of a recording, the newest first; those that cannot be read are left out.

    recording: its first part. open_part: of the part that is being written, what is flushed.

    Raises:
        OSError: the folder cannot be read.
    """
    files = sorted(part_files(recording), reverse=True)
    if open_part and open_part.chunks and open_part.path in (path for _, path in files):
        yield PartChunks(open_part)
    for _, path in files:
        if path.suffix == recording.suffix and (part := _finished(path, recording.name)):
            yield part


def _finished(path: Path, recording: str) -> PartChunks | None:
    try:
        if read_metadata(path).metadata.get(RECORDING_KEY) != recording:
            return None
        index = _index_of(path)
    except (OSError, RecordingError):
        return None
    return PartChunks(index) if index.chunks else None


def _index_of(path: Path) -> PartIndex:
    try:
        with path.open("rb") as file:
            summary = indexed_reader(file).get_summary()
        if summary and summary.chunk_indexes:
            return PartIndex(path, summary.channels, summary.chunk_indexes)
    except CORRUPT_DATA_ERRORS:
        pass
    found = scan(path).index
    return PartIndex(path, found.channels, found.chunks)
