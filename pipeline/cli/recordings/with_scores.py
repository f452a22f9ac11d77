"""Recordings with scores: if the recorder left them out, a replay makes them again."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from fantwin.pipeline.cli.options import make_folder
from fantwin.pipeline.cli.recordings.score_again import Again, score_again
from fantwin.pipeline.errors import UserError
from fantwin.pipeline.recordings.left_out import RAW, left_out
from fantwin.pipeline.recordings.run_recordings import recorded_files


@dataclass
class WithScores:
    """Files with scores, and what making them again has found, a line each."""

    files: list[Path]
    damage: list[str] = field(default_factory=list[str])
    """what is lost or could not be read"""
    remarks: list[str] = field(default_factory=list[str])


@contextmanager
def with_scores(recordings: Sequence[Path], output: Path) -> Iterator[WithScores]:
    """The files of a recording, or in their place a temporary file with all topics, beside what is made of it: it can
    be large, and the user has chosen that disk.

    Raises:
        UserError: a recording cannot be read, or scored again.
    """
    files = recorded_files(recordings)
    if not left_out(files, ("score",)) or left_out(files, (RAW,)):
        yield WithScores(files)
        return
    folder = make_folder(output.parent)
    try:
        temporary = TemporaryDirectory(dir=folder, prefix=".fantwin-")
    except OSError as error:
        raise UserError(f"{folder}: cannot be written: {error.strerror}; name another folder with -o") from error
    with temporary as name:
        found = score_again(tuple(files), Again(), Path(name))
        yield WithScores([Path(name) / files[0].name], _damage(files[0], found), _remarks(found))


def _damage(file: Path, found: dict[str, Any]) -> list[str]:
    lost = [f"{file}: {found['lost']} samples and messages lost"] if found["lost"] else []
    return [*found["damage"], *lost]


def _remarks(found: dict[str, Any]) -> list[str]:
    versions = (f"{line}: only the same version makes the same decisions" for line in found["other_version"])
    return [*(f"not scored: {problem}" for problem in found["not_scored"]), *versions]
