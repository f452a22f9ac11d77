"""Discovery of logs and tables in a folder, and the command that reads the first of them."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from fantwin.pipeline.errors import UserError
from fantwin.pipeline.sources.column_file import LogError
from fantwin.pipeline.sources.logs.formats import LOG_FORMATS, log_format

_TABLES = (".csv", ".tsv", ".txt")


@dataclass(frozen=True)
class FoundLogs:
    """Files of one format; next_command: how the first of them is read."""

    format: str
    files: tuple[str, ...]
    next_command: str


def discover_logs(folder: Path) -> list[FoundLogs]:
    """The logs and tables in a folder and the folders in it, by format.

    Raises:
        UserError: it cannot be read, or has none.
    """
    try:
        found = sorted(_formats(folder))
    except OSError as error:
        raise UserError(f"{folder}: {error.strerror}; name a folder of logs") from error
    if not found:
        raise UserError(f"{folder}: no ULog, ROS bag or table ({', '.join(_TABLES)}) in it")
    titles = dict.fromkeys(title for title, _ in found)
    grouped = {title: [path for each, path in found if each == title] for title in titles}
    return [
        FoundLogs(title, tuple(map(str, paths)), f"fantwin import {shlex.quote(str(paths[0]))} --preview")
        for title, paths in grouped.items()
    ]


def _formats(folder: Path) -> Iterator[tuple[str, Path]]:
    for path in folder.iterdir():
        if path.is_dir() and not any((path / each.marker).exists() for each in LOG_FORMATS if each.marker):
            yield from _formats(path)
            continue
        try:
            kind = log_format(path)
        except LogError:
            continue
        if kind or path.suffix.lower() in _TABLES:
            yield kind.title if kind else "table", path
