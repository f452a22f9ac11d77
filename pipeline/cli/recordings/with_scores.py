"""Recordings with scores: if the recorder left them out, a replay makes them again."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from pipeline.cli.recordings.score_again import Again, score_again
from pipeline.recordings.left_out import RAW, left_out
from pipeline.recordings.run_recordings import recorded_files


@contextmanager
def with_scores(recordings: Sequence[Path]) -> Iterator[list[Path]]:
    """The files of a recording, or in their place a temporary file with all topics.

    Raises:
        UserError: a recording cannot be read, or scored again.
    """
    files = recorded_files(recordings)
    if not left_out(files, ("score",)) or left_out(files, (RAW,)):
        yield files
        return
    with TemporaryDirectory(prefix="fantwin-") as name:
        score_again(tuple(files), Again(), Path(name))
        yield [Path(name) / files[0].name]
