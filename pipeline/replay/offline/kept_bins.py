"""Bins of recordings, kept on the disk of this host between the passes over them.

Another host of a cluster does not see the folder, and computes them again.
"""

from __future__ import annotations

import hashlib
import pickle
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, fields
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from fantwin.schemas.fan_names import NO_NAMES, FanNames
from fantwin.schemas.messages import Array
from fantwin.schemas.units import SpeedUnit
from fantwin.scoring.model.bins import Bin

AT_ONCE = 1000
"""bins that are read and written at a time"""
NAMES = tuple(field.name for field in fields(Bin))


@dataclass(frozen=True)
class RecordedTray:
    """One tray of one recording."""

    path: Path
    tray: str
    fans: int
    speed_unit: SpeedUnit
    names: FanNames = NO_NAMES


@dataclass(frozen=True)
class TrayRun:
    """A run of a tray: bins of `bin_ns`, of samples of `period_ns`. The bins of one run are read before the next."""

    tray: RecordedTray
    bin_ns: int
    period_ns: int
    bins: Iterable[Bin]


@dataclass(frozen=True)
class KeptBins:
    """A folder of bins, a file for each recording. The process that makes the folder also deletes it."""

    folder: Path
    room_bytes: int
    """room for each recording: none is kept of a longer one, or on a full disk"""

    def of(self, recording: Path) -> Iterator[TrayRun] | None:
        """The runs of a recording that has been read to its end; None where they are not kept."""
        path = self._file(recording)
        return _runs_in(path) if path.exists() else None

    def keep(self, recording: Path, runs: Iterable[TrayRun]) -> Iterator[TrayRun]:
        """The same runs, whose bins are written down as they are read."""
        if not self.folder.is_dir():
            yield from runs
            return
        file = _File(self._file(recording).with_suffix(".new"), self.room_bytes)
        for run in runs:
            file.add((run.tray, run.bin_ns, run.period_ns))
            yield TrayRun(run.tray, run.bin_ns, run.period_ns, file.written(run.bins))
        file.finish(self._file(recording))

    def _file(self, recording: Path) -> Path:
        return self.folder / f"{hashlib.sha256(str(recording).encode()).hexdigest()}.bins"


class _File:
    """A file that is written while what it keeps is read. What is kept only saves time, so the disk may refuse it."""

    def __init__(self, path: Path, room_bytes: int) -> None:
        """Begin it again."""
        self._path, self._room = path, room_bytes
        self._unread = 0
        path.unlink(missing_ok=True)

    def add(self, content: object) -> None:
        """Append something, if there is room."""
        if self._room <= 0:
            return
        text = pickle.dumps(content, protocol=5)
        self._room -= len(text)
        try:
            with self._path.open("ab") as file:
                file.write(text)
        except OSError:
            self._room = 0
        if self._room <= 0:
            self._path.unlink(missing_ok=True)

    def written(self, bins: Iterable[Bin]) -> Iterator[Bin]:
        """The same bins of a run, which are written down as they are read."""
        self._unread += 1
        left = iter(bins)
        while some := list(islice(left, AT_ONCE)):
            self.add([_column([getattr(one, name) for one in some]) for name in NAMES])
            yield from some
        self.add(None)
        self._unread -= 1

    def finish(self, path: Path) -> None:
        """Give it its name, if it has everything."""
        if self._room > 0 and not self._unread and self._path.exists():
            self._path.rename(path)


def _column(values: Sequence[Any]) -> tuple[Array, Sequence[int]]:
    """What all bins have of one name, and where each has some rows of samples, their number."""
    if np.ndim(values[0]) < 2:
        return np.array(values), ()
    return np.concatenate(values), [len(rows) for rows in values]


def _values(column: Array, lengths: Sequence[int]) -> Iterable[Any]:
    """The values of `_column`."""
    if len(lengths):
        return np.split(column, np.cumsum(lengths)[:-1])
    return column.tolist() if column.ndim == 1 else column


def _runs_in(path: Path) -> Iterator[TrayRun]:
    with path.open("rb") as file:

        def bins() -> Iterator[Bin]:
            while (columns := pickle.load(file)) is not None:
                yield from map(Bin, *(_values(*column) for column in columns))

        while True:
            try:
                tray, bin_ns, period_ns = pickle.load(file)
            except EOFError:
                return
            yield TrayRun(tray, bin_ns, period_ns, bins())
