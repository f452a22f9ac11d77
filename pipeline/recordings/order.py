"""The parts of a recording in the order of time."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from pipeline.recordings.reading import RecordingError, read_head, read_recording


def in_order(parts: Iterable[Path]) -> list[Path]:
    """The parts of a recording, the earliest first.

    Raises:
        RecordingError: one cannot be read, or is not of a recorder and so a recording in itself.
    """
    paths = list(dict.fromkeys(parts))
    if len(paths) > 1:
        for path in paths:
            if "source" in read_head(path).metadata:  # its messages are counted from 0, as those of the next one are
                raise RecordingError(
                    f"{path}: made by import or simulate or an offline replay, so no part of another: read it by itself"
                )
        paths.sort(key=_start_ns)
    elif paths:
        read_recording(paths[0])
    return paths


def _start_ns(path: Path) -> int:
    """When its first message was received; a file without any may stand anywhere."""
    return next((entry.log_time_ns for entry in read_recording(path)), 0)
