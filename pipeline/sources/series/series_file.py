"""Series of a file in memory, with names that tell them apart."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from fantwin.pipeline.sources.logs.log_file import Series
from fantwin.schemas.messages import Array


@dataclass(frozen=True)
class Label:
    """Where a series is from: its field or metric, empty where its tags alone say it, and its tags."""

    base: str
    tags: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True, eq=False)
class SeriesFile:
    """An open file of series; a `LogFile`.

    Attributes:
        title: what it is, for people.
        about: as of `Layout`; empty.
    """

    title: str
    series: Mapping[str, Series]
    notes: tuple[str, ...] = ()
    about: Mapping[str, str] = field(default_factory=dict[str, str])

    @property
    def names(self) -> Sequence[str]:
        """The names of the series."""
        return list(self.series)

    @property
    def all_names(self) -> Sequence[str]:
        """The names by which `profile_of` finds a program."""
        return self.names

    def read(self, names: Sequence[str]) -> Mapping[str, Series]:
        """See LogFile."""
        return {name: self.series[name] for name in names}


def named(found: Iterable[tuple[Label, Array, Array]]) -> dict[str, Series]:
    """Series by name: `base{tag=value}`, without the tags that are the same in all. found: labels, times and values."""
    rows = list(found)
    values: dict[str, set[str]] = {}
    for label, _, _ in rows:
        for key, value in label.tags:
            values.setdefault(key, set()).add(value)
    everywhere = Counter(key for label, _, _ in rows for key, _ in label.tags)
    constant = {key for key, seen in values.items() if len(seen) == 1 and everywhere[key] == len(rows)}
    series: dict[str, Series] = {}
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
        series[name] = Series(np.asarray(t_ns, np.int64), np.asarray(numbers, np.float64))
    return series
