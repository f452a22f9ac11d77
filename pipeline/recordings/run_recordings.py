"""The recordings of one run: that of one recorder, or those of its shards, which each record some of the trays.

Where files of many recordings are given at once, their metadata say which are parts of one recording.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from fantwin.pipeline.config.registry import RECORDER, STAGES
from fantwin.pipeline.recordings.reading import RecordingError, RecordingMetadata, read_metadata
from fantwin.pipeline.recordings.records import ACTIVE_SUFFIX

_SHOWING = {row.name for row in STAGES.values() if row.writes in ((), ("request",)) and row.name != RECORDER}
"""stages that present a site and decide nothing"""
_OF_THE_PLACE = {"bus", "launcher", "run_folder", *_SHOWING}
"""where keys begin that say where and how a site runs, and not what it decides"""


@dataclass(frozen=True)
class File:
    """A file, and what its metadata say of the recording that it belongs to."""

    path: Path
    is_whole: bool
    """it is no part: it was made by import, simulate or an offline replay"""
    run: tuple[str | None, ...]
    """what all parts have in common"""
    session: str | None
    """of the recorder"""
    recording: str | None
    """the name of its first part, in the same folder"""

    def continues(self, other: File) -> bool:
        """Whether both are parts of one recording: of one session of a recorder, wherever they are, or of one name in
        one folder."""
        if self.is_whole or other.is_whole or self.run != other.run:
            return False
        is_same_session = self.session is not None and self.session == other.session
        return is_same_session or (self.path.parent, self.recording) == (other.path.parent, other.recording)


def describe(path: Path) -> File:
    """What a file says of itself.

    Raises:
        RecordingError: it cannot be read.
    """
    found = read_metadata(path)
    about = found.metadata
    attached = hashlib.sha256()
    for name, content in sorted(found.attachments.items()):
        attached.update(f"{name} {len(content)}\n".encode() + content)
    run = (about.get("site"), *deciding_overrides(found), attached.hexdigest())
    return File(path, "source" in about, run, about.get("session"), about.get("recording"))


def deciding_overrides(metadata: RecordingMetadata) -> list[str]:
    """The recorded overrides but for those of the place, which differ from host to host and from start to start."""
    try:
        overrides = list(map(str, json.loads(metadata.metadata.get("overrides", "[]"))))
    except (ValueError, TypeError):
        return [metadata.metadata["overrides"]]  # damaged: reported where they are used
    return [each for each in overrides if each.partition("=")[0].partition(".")[0].strip() not in _OF_THE_PLACE]


def recordings_of(files: Iterable[File]) -> list[tuple[Path, ...]]:
    """The files of each recording together, in the order in which recordings are first named."""
    groups: list[list[File]] = []
    for file in files:
        linked = [group for group in groups if any(file.continues(other) for other in group)]
        if linked:
            first, *others = linked
            first += [*(member for other in others for member in other), file]
            groups = [group for group in groups if not any(group is other for other in others)]
        else:
            groups.append([file])
    return [tuple(file.path for file in group) for group in groups]


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
