"""The parts of a recording backwards, each read by its index: also the part that is being written."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property
from pathlib import Path

from fantwin.pipeline.recordings.indexed import IndexedRecording, PartIndex
from fantwin.pipeline.recordings.parts import part_files
from fantwin.pipeline.recordings.reading import RecordingMetadata, read_metadata
from fantwin.pipeline.recordings.records import RecordingError
from fantwin.pipeline.recordings.run_recordings import RECORDING_KEY
from fantwin.pipeline.recordings.scan import scan


class PartChunks(IndexedRecording):
    """The chunks of one part."""

    @cached_property
    def metadata(self) -> RecordingMetadata:
        """Metadata and attachments. Raises RecordingError, OSError."""
        return read_metadata(self.file)

    @property
    def site(self) -> str:
        """The name of the site; empty if there is no message."""
        return next((key.split("/")[1] for key, _ in self.channels.values()), "")


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
        if part := PartChunks.of(path):
            return part
        found = scan(path).index
    except (OSError, RecordingError):
        return None
    return PartChunks(PartIndex(path, found.channels, found.chunk_indexes)) if found.chunk_indexes else None
