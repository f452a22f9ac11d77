"""The parts of a recording in order, and a check that each message is used once."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterable
from pathlib import Path

from fantwin.pipeline.recordings.reading import RecordingError, read_metadata, read_recording
from fantwin.pipeline.recordings.records import whole_number
from fantwin.pipeline.recordings.run_recordings import recorded_files


def in_order(parts: Iterable[Path]) -> list[Path]:
    """The parts of a recording, or of the recordings of several shards, the earliest first. A folder stands for the
    recordings in it.

    Raises:
        RecordingError: one cannot be read, or was not made by a recorder and so is not a part.
    """
    paths = recorded_files(parts)
    if len(paths) > 1:
        for path in paths:
            if "source" in read_metadata(path).metadata:  # its sequence numbers start at 0, as those of the next do
                raise RecordingError(
                    f"{path}: made by import, simulate or an offline replay, so it is not a part: read it by itself"
                )
        paths = _sessions_in_order(paths)
    elif paths:
        read_recording(paths[0])
    return paths


def _sessions_in_order(paths: Iterable[Path]) -> list[Path]:
    """By the start of each recorder session, then by part number: the host's clock may be set back between parts."""
    sessions: dict[str, list[tuple[int, int, Path]]] = {}
    for path in paths:
        metadata = read_metadata(path).metadata
        numbered = (whole_number(metadata.get("part", "")) or 0, _start_ns(path), path)
        sessions.setdefault(metadata.get("session") or str(path), []).append(numbered)
    ordered = [sorted(parts) for parts in sessions.values()]
    return [path for parts in sorted(ordered, key=lambda parts: parts[0][1]) for _, _, path in parts]


def _start_ns(path: Path) -> int:
    """When its first message was received; 0 without any, since its place does not matter then."""
    return next((envelope.received_t_ns for envelope in read_recording(path)), 0)


class Seen:
    """The sequence numbers of a stream that have come, as ranges: one more than there are gaps."""

    def __init__(self) -> None:
        self._first: list[int] = []
        self._next: list[int] = []

    def is_new(self, sequence: int) -> bool:
        """Add a number. Returns whether it came for the first time."""
        at = bisect_right(self._first, sequence)  # the range before it may hold or touch it
        if at and sequence < self._next[at - 1]:
            return False
        joins_next = at < len(self._first) and sequence + 1 == self._first[at]
        if at and sequence == self._next[at - 1]:
            self._next[at - 1] = self._next.pop(at) if joins_next else sequence + 1
            if joins_next:
                del self._first[at]
        elif joins_next:
            self._first[at] = sequence
        else:
            self._first.insert(at, sequence)
            self._next.insert(at, sequence + 1)
        return True
