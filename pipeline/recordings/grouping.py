"""Which files are parts of one recording, where files of many recordings are given at once."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from fantwin.pipeline.config.registry import RECORDER, STAGES
from fantwin.pipeline.recordings.reading import RecordingMetadata, read_metadata

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
