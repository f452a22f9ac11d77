"""Series of a file in memory, with names that tell them apart."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from fantwin.pipeline.sources.column_file import Column, ColumnFile
from fantwin.schemas.messages import Array


@dataclass(frozen=True)
class Label:
    """Where a series is from: its field or metric, empty where its tags alone say it, and its tags."""

    base: str
    tags: tuple[tuple[str, str], ...] = ()


class SeriesFile(ColumnFile):
    """An open file of series, which are read already."""

    def __init__(self, title: str, series: Mapping[str, Column], notes: Sequence[str] = ()) -> None:
        self.title, self.names, self.notes = title, list(series), (title, *notes)
        self._series = series

    def read(self, names: Sequence[str]) -> Mapping[str, Column]:
        """See ColumnFile."""
        return {name: self._series[name] for name in names}


class JoinedFile(ColumnFile):
    """The columns of several files by their times; of several of one name the first."""

    def __init__(self, files: Sequence[ColumnFile]) -> None:
        self._file_of = {name: file for file in reversed(files) for name in file.names}
        seen = Counter(name for file in files for name in file.names)
        self._again = [name for name in self._file_of if seen[name] > 1]
        self.title = f"columns of {len(files)} files by their times"
        self.names = list(self._file_of)

    def read(self, names: Sequence[str]) -> Mapping[str, Column]:
        """See ColumnFile."""
        found: dict[str, Column] = {}
        again = [f"several files have {name!r}: that of the first is read" for name in self._again if name in names]
        self.notes = [self.title, *again]
        for file in dict.fromkeys(self._file_of[name] for name in names):
            found |= file.read([name for name in names if self._file_of[name] is file])
            self.notes += file.notes
        return found


def named(found: Iterable[tuple[Label, Array, Array]]) -> dict[str, Column]:
    """Series by name: `base{tag=value}`, without the tags that are the same in all. found: labels, times and values."""
    rows = list(found)
    values: dict[str, set[str]] = {}
    for label, _, _ in rows:
        for key, value in label.tags:
            values.setdefault(key, set()).add(value)
    everywhere = Counter(key for label, _, _ in rows for key, _ in label.tags)
    constant = {key for key, seen in values.items() if len(seen) == 1 and everywhere[key] == len(rows)}
    series: dict[str, Column] = {}
    for label, t_ns, numbers in rows:
        tags = [(key, value) for key, value in label.tags if key not in constant]
        if label.base:
            inside = ",".join(f"{key}={value}" if key else value for key, value in tags)
            name = f"{label.base}{{{inside}}}" if inside else label.base
        else:
            name = " ".join(value for _, value in tags) or " ".join(value for _, value in label.tags)
        name = " ".join(name.split())
        again = 1
        while name in series:
            again += 1
            name = f"{name.partition(' [')[0]} [{again}]"
        series[name] = Column(np.asarray(t_ns, np.int64), np.asarray(numbers, np.float64))
    return series
