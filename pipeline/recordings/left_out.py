"""What a recorder left out of a recording on purpose, in words: what is missing, and which command makes it."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from pathlib import Path

from fantwin.pipeline.recordings.reading import read_metadata

RAW = "raw"


def left_out(paths: Iterable[Path], topics: Collection[str]) -> list[str]:
    """Which of these topics the recorder left out of a recording, given its parts.

    Raises:
        RecordingError: a part cannot be read.
    """
    found = {topic for path in paths for topic in read_metadata(path).left_out}
    return [topic for topic in topics if topic in found]


def left_out_hint(paths: Collection[Path], topics: Collection[str]) -> str:
    """A line about those of these topics that the recorder left out, and how to make them; empty if there are none."""
    missing = left_out(paths, topics)
    if not missing:
        return ""
    line = f"its recorder left out {', '.join(missing)} (recorder.topics)"
    if left_out(paths, (RAW,)):
        return f"{line}, and without {RAW} nothing can be made again"
    return f"{line}: {_replay(paths)} makes a recording with all topics"


def how_to_score(paths: Collection[Path]) -> str:
    """How to make the scores that a recording does not have, in a line."""
    return left_out_hint(paths, ("score",)) or f"{_replay(paths, '--twin TWIN.onnx ')} makes them with a twin"


def _replay(paths: Collection[Path], options: str = "") -> str:
    return f"`fantwin replay {' '.join(map(str, paths))} --offline {options}-o WHOLE.mcap`"
