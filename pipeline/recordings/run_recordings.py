"""The recordings of one run: that of one recorder, or those of its shards, which each record some of the trays."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

from fantwin.pipeline.recordings.reading import RecordingError, RecordingMetadata, read_metadata
from fantwin.pipeline.recordings.records import ACTIVE_SUFFIX

RECORDING_KEY = "recording"
"""in the metadata of what a recorder writes: the name of its first part"""

CLIPS = "clips"
"""the folder of clips, beside the recording"""


def recorded_files(paths: Iterable[Path], *, with_unfinished: bool = False) -> list[Path]:
    """The files, and in the place of a folder the parts of all recordings that recorders have finished there.

    with_unfinished: those that are still being written, too.

    Raises:
        RecordingError: a folder cannot be read, or has no recording of a recorder.
    """
    found: list[Path] = []
    for path in paths:
        found += _in_folder(path, with_unfinished) if path.is_dir() else [path]
    return list(dict.fromkeys(found))


def run_metadata(parts: Sequence[Path]) -> RecordingMetadata:
    """The metadata of the first part, with what others say about further trays, and their twins.

    Raises:
        RecordingError: one cannot be read.
    """
    first, *others = map(read_metadata, parts)
    if not others:
        return first
    metadata, attachments, is_damaged = dict(first.metadata), dict(first.attachments), first.is_damaged
    trays = dict.fromkeys(first.trays)
    for other in others:
        trays |= dict.fromkeys(other.trays)
        metadata = {**other.metadata, **metadata}
        attachments = {**other.attachments, **attachments}
        is_damaged |= other.is_damaged
    return replace(
        first, metadata=metadata | {"trays": ",".join(trays)}, attachments=attachments, is_damaged=is_damaged
    )


def _in_folder(folder: Path, with_unfinished: bool) -> list[Path]:
    suffixes = (".mcap", f".mcap{ACTIVE_SUFFIX}") if with_unfinished else (".mcap",)
    try:
        files = sorted(path for path in folder.iterdir() if path.name.endswith(suffixes) and path.is_file())
    except OSError as error:
        raise RecordingError(f"{folder}: cannot be read: {error.strerror}") from error
    found = [path for path in files if RECORDING_KEY in read_metadata(path).metadata]
    if not found:
        raise RecordingError(f"{folder}: no recording that a recorder has finished in this folder; name a file")
    return found
