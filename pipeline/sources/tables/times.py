"""The times of a table: numbers with a unit, dates, or a date and a time of day in two columns."""

from __future__ import annotations

import math
import shlex
from array import array
from collections.abc import Sequence

import numpy as np

from fantwin.pipeline.errors import UserError
from fantwin.pipeline.sources.column_file import NO_TIME
from fantwin.pipeline.sources.tables.dates import DateColumn, is_time_of_day
from fantwin.pipeline.sources.tables.fan_columns import require, with_unit
from fantwin.pipeline.sources.tables.layout import Layout
from fantwin.pipeline.sources.tables.numbers import NumberColumn
from fantwin.pipeline.sources.tables.units import NS_PER_UNIT
from fantwin.pipeline.sources.tables.zones import as_utc, zone_of
from fantwin.pipeline.sources.wanted import Wanted
from fantwin.schemas.messages import FURTHEST_T_NS, Array
from fantwin.schemas.units import NS_PER_S

DATE_UNIT = "iso"
_FINER_UNIT = {"s": "ms", "ms": "us", "us": "ns"}
_YEAR_2000_NS = 946_684_800 * NS_PER_S
_DAY, _NS_PER_DAY, _DAYS_TO_1970 = "days", 86_400 * NS_PER_S, 25_569
_FIRST_DAY, _LAST_DAY = 30_000, 60_000
"""dates as spreadsheets count them, from 1982 to 2064"""
_USUAL = ("time", "timestamp", "t", "date", "datetime", "zeit", "_time", "datum", "elapsed", "ts", "x_value", "clock")
"""names of columns of times"""
TIME_UNITS = (*NS_PER_UNIT, DATE_UNIT)


class TimeColumn:
    """The column of times, or the two of date and time of day, in ns."""

    def __init__(self, layout: Layout, given: str, wanted: Wanted, decimal: str = "") -> None:
        """given: `NAME`, `NAME:UNIT` or `DATE+TIME`. decimal: mark of the numbers; empty: found, as of other columns.

        Without a unit, numbers are in the one that the file names, else since 1970 in the one that fits, else in s, and
        anything else is a date.

        Raises:
            UserError: there is no such column, order or zone.
        """
        names = layout.all_names
        self._path = layout.path
        self.names, self._unit = time_names(layout, given)
        for name in self.names:
            require(str(layout.path), names, name)
        self.name = "+".join(self.names)
        columns = [layout.column(name) for name in self.names]
        self._indices = [each.index for each in columns]
        self._zone = zone_of(wanted.zone) if wanted.zone else None
        self._is_given = bool(self._unit)
        self._by_file = False
        if not self._unit and columns[0].unit in NS_PER_UNIT:
            self._unit, self._by_file = columns[0].unit, True
        self._dates = DateColumn(layout.path, self.name, wanted.dates, has_zone=bool(wanted.zone))
        self._is_final = bool(decimal)
        self._decimal = decimal or columns[0].decimal
        self._numbers = NumberColumn(layout.path, self.name, self._indices[0], self._decimal, is_final=self._is_final)
        self._first = ""
        self._far = 0
        self._t_ns = array("q")
        self.notes: list[str] = []
        self.format = ""

    def add(self, rows: Sequence[Sequence[str]]) -> None:
        """Append the cells of some rows. Raises UserError for a time beyond the year 2116."""
        cells = self._cells(rows)
        self._first = self._first or next(filter(None, map(str.strip, cells)), "")
        if not self._first:
            self._t_ns.extend([NO_TIME] * len(cells))
            return
        if not self._unit or (self._by_file and not self._t_ns and self._unit != DATE_UNIT):
            self._unit = self._found_unit()
        if self._unit == DATE_UNIT:
            if self._t_ns:  # rows before the first time
                self._dates.add([""] * len(self._t_ns))
                del self._t_ns[:]
            self._dates.add(cells)
            return
        t_ns = self._counted(cells, NS_PER_UNIT.get(self._unit, _NS_PER_DAY))
        if self._unit == _DAY:
            t_ns = np.where(t_ns == NO_TIME, NO_TIME, t_ns - _DAYS_TO_1970 * _NS_PER_DAY)
        self._t_ns.frombytes(t_ns.tobytes())

    def _counted(self, cells: Sequence[str], scale: int) -> Array:
        """(cells,) times in ns. Whole numbers are exact: a float cannot hold ns since 1970."""
        try:
            whole = np.array(list(map(int, cells)), np.int64)
        except (ValueError, OverflowError):
            pass
        else:
            near = np.abs(whole.astype(np.float64)) * scale < FURTHEST_T_NS
            self._far += int(np.count_nonzero(~near))
            return np.where(near, np.where(near, whole, 0) * scale, NO_TIME)
        try:
            values = np.array([float(cell) if cell else math.nan for cell in cells])
            if self._is_final or self._decimal != ".":
                raise ValueError
        except ValueError:
            values = np.array([self._numbers.number(cell) for cell in cells])
        finite = np.isfinite(values)
        near = finite & (np.abs(values) < FURTHEST_T_NS / scale)
        self._far += int(np.count_nonzero(finite & ~near))
        values = np.where(near, values, 0.0)
        whole = values.astype(np.int64)
        t_ns = np.where(whole == values, whole * scale, np.rint(values * scale).astype(np.int64))
        return np.where(near, t_ns, NO_TIME)

    def _cells(self, rows: Sequence[Sequence[str]]) -> list[str]:
        if len(self._indices) == 1:
            index = self._indices[0]
            return [row[index] for row in rows]
        first, second = self._indices
        cells = [(row[first].strip(), row[second].strip()) for row in rows]
        return [(f"{b} {a}" if is_time_of_day(a) else f"{a} {b}") if a and b else "" for a, b in cells]

    def _found_unit(self) -> str:
        """The unit of the first time: what the file names, dates, or numbers since 1970 in the one that fits."""
        value = self._numbers.number(self._first)
        if math.isnan(value):
            return DATE_UNIT
        if self._unit or self._numbers.unit in NS_PER_UNIT:
            self._by_file = True
            return self._unit or self._numbers.unit
        if "dat" in self.name.lower() and _FIRST_DAY < value < _LAST_DAY:
            self._by_file = True
            self.notes.append(f"dates of {self.name!r} are numbers, days since 1899 as in a spreadsheet")
            return _DAY
        if abs(value) * NS_PER_S < FURTHEST_T_NS:
            self._by_file = value * NS_PER_S > _YEAR_2000_NS  # since 1970
            return "s"
        fits = [unit for unit in ("ms", "us", "ns") if _YEAR_2000_NS < value * NS_PER_UNIT[unit] < FURTHEST_T_NS]
        if len(fits) == 1:
            self._by_file = True
            self.notes.append(f"times of {self.name!r} are in {fits[0]} since 1970, by their size")
            return fits[0]
        return "s"

    def values(self) -> Array:
        """(rows,) times in ns. Raises UserError if none could be read."""
        t_ns = self._date_values() if self._unit == DATE_UNIT else np.asarray(self._t_ns)
        known = t_ns != NO_TIME
        if self._far > np.count_nonzero(known):
            finer = _FINER_UNIT.get(self._unit)
            hint = f"is it in ms, us or ns? use --time {self.name}:{finer}" if finer else "choose another time column"
            raise UserError(
                f"{self._path}: column {self.name!r} in {self._unit} gives times beyond the year 2116: {hint}"
            )
        if not known.any():
            raise UserError(
                f"{self._path}: column {self.name!r} has no times in {self._unit or DATE_UNIT}, but for example "
                f"{self._first!r}; use numbers in s, ms, us or ns, or dates such as 2026-01-31 13:45:00.250"
            )
        if self._numbers.problem:
            raise self._numbers.problem
        if self._unit != DATE_UNIT:
            self.format = f"numbers in {self._unit}{' since 1970' if t_ns[np.argmax(known)] > _YEAR_2000_NS else ''}"
        return t_ns

    def _date_values(self) -> Array:
        t_ns, zoned, self.format = self._dates.values()
        naive = (t_ns != NO_TIME) & ~zoned & (not self._dates.is_time_of_day)
        if naive.any() and self._zone:
            t_ns[naive], notes = as_utc(self.name, t_ns[naive], self._zone)
            self.notes += notes
            self.format += f", {self._zone.key}"
        elif naive.any():
            self.notes.append(f"dates of {self.name!r} have no time zone: UTC assumed; --zone Europe/Berlin names one")
        is_far = (t_ns != NO_TIME) & (np.abs(t_ns) >= FURTHEST_T_NS)
        self._far = int(np.count_nonzero(is_far))
        t_ns[is_far] = NO_TIME
        return t_ns

    @property
    def is_notable(self) -> bool:
        """Whether how the times are written is worth a line: they are no ISO dates, and no numbers."""
        return self._unit == DATE_UNIT and not self._dates.is_iso

    @property
    def assumed(self) -> tuple[str, str] | None:
        """What was assumed of the unit, and the option that says otherwise; None: nothing was."""
        if self._is_given or self._by_file or self._unit != "s":
            return None
        return "times in s", f"--time {shlex.quote(f'{self.name}:ms')}"


def time_names(layout: Layout, given: str) -> tuple[list[str], str]:
    """The one or two columns that a user means by `NAME`, `NAME:UNIT` or `DATE+TIME`, and the unit. One of a pair of
    date and time of day means both."""
    names = layout.all_names
    name, unit = with_unit(given, names, TIME_UNITS)
    pair = usual_time(layout).split("+")
    parts = [part.strip() for part in name.split("+")]
    if name not in names and len(parts) == 2 and all(part in names for part in parts):
        return parts, DATE_UNIT
    return (pair, DATE_UNIT) if len(pair) == 2 and name in pair else ([name], unit)


def usual_time(layout: Layout) -> str:
    """The time column that a table shows by its names and cells, as `--time` takes it; empty: none, or several."""
    dated = [each for each in layout.columns if each.kind == "time"]
    if len(dated) == 2 and is_time_of_day(dated[0].cells[0]) != is_time_of_day(dated[1].cells[0]):
        return "+".join(each.name for each in dated)
    named = (each for word in _USUAL for each in layout.columns if each.kind and _is_called(each.name.lower(), word))
    return next((each.name for each in (*(dated if len(dated) == 1 else ()), *named, *dated)), "")


def _is_called(name: str, word: str) -> bool:
    return name == word or name.split()[:1] == [word] or name.startswith((f"{word}_", f"{word}("))
