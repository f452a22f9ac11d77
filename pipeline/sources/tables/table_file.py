"""Reading of a measured table: its columns, its times and its units.

How a file holds its table is found in `layout`, its numbers in `numbers`, its times in `times`. pandas would replace
only the reading of cells, and every installation would need it.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import islice

import numpy as np

from fantwin.pipeline.errors import UsageError, UserError
from fantwin.pipeline.sources.column_file import NO_TIME, Column, ColumnFile
from fantwin.pipeline.sources.tables.layout import Layout
from fantwin.pipeline.sources.tables.numbers import NumberColumn, OtherMarkError
from fantwin.pipeline.sources.tables.profiles import profile_of
from fantwin.pipeline.sources.tables.rows import OddRows, rows_of
from fantwin.pipeline.sources.tables.times import TimeColumn, time_names, usual_time
from fantwin.pipeline.sources.tables.units import NS_PER_UNIT
from fantwin.pipeline.sources.wanted import Wanted
from fantwin.schemas.messages import FURTHEST_T_NS, LARGEST_PERIOD_NS, Array

_ROWS_IN_PART = 4096


class TableFile(ColumnFile):
    """A table with a row for each time."""

    is_rows = True

    def __init__(self, layout: Layout, wanted: Wanted) -> None:
        """Raises UserError: there is no such column of times."""
        self._layout = layout
        self.title, self.names, self.about = layout.in_words, layout.all_names, layout.about
        named_twice = [each for each in layout.columns if each.second not in ("", each.name)]
        self.labels = {each.second: each.name for each in named_twice} | {
            each.name: each.second for each in named_twice
        }
        profile = profile_of(self)
        found = "" if wanted.period else (profile and profile.time_in(self.names)) or usual_time(layout)
        self._time = wanted.time or found
        self._wanted = replace(wanted, dates=wanted.dates or (profile.dates if profile else ""))
        of_time = time_names(layout, self._time)[0] if self._time else []
        numbers = (each.name for each in layout.columns if each.kind == "number")
        self.numbers = [name for name in numbers if name and name not in of_time]

    def read(self, names: Sequence[str]) -> Mapping[str, Column]:
        """See ColumnFile."""
        odd = OddRows()

        def rows() -> Iterator[list[str]]:
            nonlocal odd
            odd = OddRows()
            return rows_of(self._layout, odd)

        times, columns, count = read_cells(self._layout, self._time, names, self._wanted, rows)
        problem = None
        try:
            t_ns = times.values() if times else self._counted_times(count)
        except UserError as error:
            problem, t_ns = error, np.full(count, NO_TIME)
        of_times = times.notes if times else []
        if times:
            self.times, self.assumed = f"{times.name}, {times.format}", times.assumed
            of_times = [
                *([f"times of {times.name!r}: {times.format}"] if times.is_notable and times.format else []),
                *of_times,
            ]
        twice = [
            f"several columns are called {name!r}: the first is read; the next is {f'{name} [2]'!r}"
            for name in names
            if f"{name} [2]" in self._layout.names
        ]
        self.notes = [
            *of_times,
            *([self.title] if self._layout.head != 1 else []),
            *twice,
            *odd.in_words(self._layout),
        ]
        has_time = t_ns != NO_TIME
        found: dict[str, Column] = {}
        for name, column in columns.items():
            unsure = column.problem
            values = np.full(count, np.nan) if unsure else column.values
            unit = self._layout.column(name).unit or column.unit
            found[name] = Column(t_ns, values, unit, column.texts(has_time), unsure or problem)
        return found

    def _counted_times(self, rows: int) -> Array:
        """Times of a table without a time column: rows `period` apart, from 0."""
        period = self._wanted.period
        if not period:
            raise UsageError("a table needs --time COLUMN[:UNIT], or --period 10ms if it has no time column")
        match = re.fullmatch(r"(\d{1,9}\.?\d*|\.\d+)\s*(s|ms|us|ns)", period.strip())
        period_ns = round(float(match[1]) * NS_PER_UNIT[match[2]]) if match else 0
        if not 0 < period_ns <= LARGEST_PERIOD_NS:
            raise UsageError(f"--period {period}: give the time between samples with its unit, for example 10ms")
        if rows * period_ns >= FURTHEST_T_NS:
            raise UsageError(f"--period {period}: beyond the year 2116 at its end; give a shorter period")
        return np.arange(rows, dtype=np.int64) * period_ns


def read_cells(
    layout: Layout, time: str, names: Sequence[str], wanted: Wanted, rows: Callable[[], Iterator[list[str]]]
) -> tuple[TimeColumn | None, dict[str, NumberColumn], int]:
    """The times, the columns of these names with their numbers, and the number of rows.

    Rows are read again where a column shows another decimal mark further down. Raises UserError.
    """
    shown: dict[str, str] = {}
    while True:
        times = TimeColumn(layout, time, wanted, wanted.decimal or shown.get(f"time {time}", "")) if time else None
        columns = {
            name: NumberColumn(
                layout.path,
                name,
                layout.column(name).index,
                wanted.decimal or shown.get(name) or layout.column(name).decimal,
                is_final=bool(wanted.decimal) or name in shown,
            )
            for name in names
        }
        count = 0
        try:
            for part in _parts(rows()):
                for column in (*filter(None, [times]), *columns.values()):
                    column.add(part)
                count += len(part)
        except OtherMarkError as found:
            shown[f"time {time}" if times and found.name == times.name else found.name] = found.decimal
        else:
            return times, columns, count


def _parts(rows: Iterator[list[str]]) -> Iterator[list[list[str]]]:
    """The rows, some thousand at a time."""
    while part := list(islice(rows, _ROWS_IN_PART)):
        yield part
