"""What recordings must survive: a writer that is killed, and a disk that is full."""

from __future__ import annotations

import resource
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from fantwin.pipeline.recordings.writing import RecordingWriter
from tests.support.written_recordings import RAW_KEY, raw


def kill_a_recorder(path: Path, flushed: int) -> None:
    """Leave what kill -9 leaves of a recorder with unflushed messages: the system closes and unlocks its file."""
    writer = RecordingWriter(path, {})
    for sequence in range(flushed):
        writer.add_message(RAW_KEY, raw(sequence), sequence)
    writer.flush()
    for sequence in range(flushed, flushed + 3):
        writer.add_message(RAW_KEY, raw(sequence), sequence)
    writer._file.close()


@contextmanager
def disk_of(size: int) -> Iterator[None]:
    """Files of this process cannot grow beyond `size` bytes: the system writes a part, then refuses."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
