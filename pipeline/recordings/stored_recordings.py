"""The finished recordings in a folder: which of them may be deleted, and the space that all of them take.

Recordings of earlier runs, of other names and of other shards count too. Only files that a recorder wrote under their
present name may be deleted: no import, no clip, and no part that was renamed to keep it.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from fantwin.pipeline.recordings.indexed import last_message_ns
from fantwin.pipeline.recordings.reading import read_metadata
from fantwin.pipeline.recordings.records import ACTIVE_SUFFIX, RecordingError, UnreadableError, whole_number
from fantwin.pipeline.recordings.run_recordings import CLIPS, RECORDING_KEY

SUFFIX = ".mcap"


class StoredPart(NamedTuple):
    """A finished part of a recording."""

    last_ns: int
    """time at which its last message was received; that of its start if its index does not say it"""
    number: int
    path: Path


@dataclass(frozen=True)
class Stored:
    """The recordings and clips in the folder at one time."""

    parts: tuple[StoredPart, ...] = ()
    """the oldest first"""
    finished_bytes: int = 0
    """of parts"""
    clips_bytes: int = 0
    """of all clips"""
    open_bytes: int = 0
    """size of the parts that are being written"""


class StoredRecordings:
    """The folder of a recording. A file is read only once; its size and time then show whether it has changed."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._known: dict[tuple[Path, int, int], StoredPart | None] = {}

    def look(self) -> Stored:
        """The recordings and clips that are there now.

        Raises:
            OSError: the folder cannot be read.
        """
        known, self._known = self._known, {}
        parts: list[StoredPart] = []
        finished_bytes = clips_bytes = open_bytes = 0
        for path, size, written_ns in _files(self._folder):
            if path.name.endswith(SUFFIX + ACTIVE_SUFFIX):
                open_bytes += size
            elif path.suffix == SUFFIX:
                key = path, size, written_ns
                with suppress(UnreadableError):  # too many files are open, say: it is tried again
                    self._known[key] = known[key] if key in known else _part(path)
                if part := self._known.get(key):
                    parts.append(part)
                    finished_bytes += size
        with suppress(FileNotFoundError):
            clips_bytes = sum(size for path, size, _ in _files(self._folder / CLIPS) if path.suffix == SUFFIX)
        return Stored(tuple(sorted(parts)), finished_bytes, clips_bytes, open_bytes)


def _files(folder: Path) -> Iterator[tuple[Path, int, int]]:
    """Each file with its size and the time at which it was written."""
    for path in folder.iterdir():
        with suppress(FileNotFoundError):
            found = path.stat()
            yield path, found.st_size, found.st_mtime_ns


def _part(path: Path) -> StoredPart | None:
    """The part in a file; None if no recorder wrote it under this name. Raises UnreadableError."""
    try:
        metadata = read_metadata(path).metadata
    except UnreadableError:
        raise
    except RecordingError:
        return None
    first = Path(metadata.get(RECORDING_KEY, ""))
    named = re.fullmatch(rf"{re.escape(first.stem)}(?:-(\d+))?{re.escape(first.suffix)}", path.name)
    began_ns = whole_number(metadata.get("started_t_ns", ""))
    if not (first.name and named and "session" in metadata and began_ns is not None):
        return None
    return StoredPart(last_message_ns(path) or began_ns, int(named[1] or 1), path)
