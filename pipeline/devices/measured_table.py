"""Measured tables: a text file with columns, as a logger wrote it, to samples with strictly increasing times.

Irregularities of real files are handled here and nowhere else: a byte-order mark and blanks in column names; commas,
semicolons or tabs between columns; decimal commas; times as numbers or dates; rows out of order, repeated times, empty
cells. Every change to the data is counted (`Repairs`).

pandas would replace only the reading of cells, and every installation would need it.
"""

from __future__ import annotations

import csv
import difflib
import math
import re
import shlex
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np

from pipeline.errors import UserError
from schemas.messages import FURTHEST_T_NS, Array
from schemas.units import NS_PER_S, RAD_S_PER_UNIT

NS_PER_UNIT = {"s": NS_PER_S, "ms": 1_000_000, "us": 1_000, "ns": 1}
RAD_S_PER_TABLE_UNIT = {**RAD_S_PER_UNIT, "hz": 2 * math.pi, "deg/s": math.pi / 180}
DATE_UNIT = "iso"
GAP_IN_MEDIAN_PERIODS = 5.0
OUT_OF_ORDER_NS = NS_PER_S  # rows further back than this mean that the clock was set

_DELIMITERS = ",;\t"
_UNIX_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_DATE_AND_FRACTION = re.compile(r"(\d\d:\d\d:\d\d)[:,](\d+)")  # some loggers write 17:14:08:947, or 17:14:08,947
_FINER_UNIT = {"s": "ms", "ms": "us", "us": "ns"}
_NOT_MEASURED = {"", "nan", "na", "n/a", "null", "none", "-"}


@dataclass(frozen=True)
class Repairs:
    """Counts of irregularities in a table, in rows unless stated otherwise."""

    rows: int = 0
    without_time: int = 0
    """dropped: their time cannot be read"""
    out_of_order: int = 0
    """sorted by time"""
    repeated: int = 0
    """merged into the row of the same time: mean speed, last command"""
    before_command: int = 0
    """dropped: no command was known yet"""
    commands_held: int = 0
    """cells without a command: the previous command is held"""
    speeds_missing: int = 0
    """cells without a speed: NaN"""


@dataclass(frozen=True, eq=False)
class Table:
    """Samples of one or more fans. No speed is filled in: one that was not measured is NaN."""

    path: Path
    t_ns: Array
    """(n,) int64, strictly increasing; since 1970 if the table has dates, else from the zero of its time column"""
    command: Array
    """(n, fans), never NaN, in the unit of the table"""
    speed_rad_s: Array
    """(n, fans), NaN where not measured"""
    speed_unit: str
    """unit of the table: rpm, rad/s, hz or deg/s"""
    repairs: Repairs
    assumed: str = ""
    """units that were assumed, and how to give them, in one line; empty if all were given"""

    @property
    def fans(self) -> int:
        """Number of fans."""
        return self.command.shape[1]

    @property
    def duration_s(self) -> float:
        """Time from the first sample to the last."""
        return float(self.t_ns[-1] - self.t_ns[0]) / NS_PER_S

    @property
    def median_period_s(self) -> float:
        """Median time between samples."""
        return float(np.median(np.diff(self.t_ns))) / NS_PER_S

    @property
    def gaps(self) -> int:
        """Number of intervals longer than five median periods."""
        return int(np.count_nonzero(np.diff(self.t_ns) > GAP_IN_MEDIAN_PERIODS * self.median_period_s * NS_PER_S))

    @property
    def notes(self) -> tuple[str, ...]:
        """One line per kind of irregularity, for people."""
        found = self.repairs
        counts = (
            (found.without_time, "rows dropped: their time cannot be read"),
            (found.out_of_order, "rows out of order, sorted by time"),
            (found.repeated, "rows with the time of another, merged: mean speed, last command"),
            (found.before_command, "rows before the first command dropped"),
            (found.commands_held, "cells without a command: the previous command is held"),
            (found.speeds_missing, "cells without a speed, not filled"),
            (self.gaps, f"gaps longer than {GAP_IN_MEDIAN_PERIODS * self.median_period_s:.3g} s, not filled"),
        )
        notes = [f"{count} {text}" for count, text in counts if count]
        if 2 * found.repeated > found.rows:
            notes.append("most times repeat: the time column is too coarse; choose another, or use --period")
        return tuple(notes)


def read_table(
    path: Path, time: str | None, command: Sequence[str], speed: Sequence[str], *, period: str | None = None
) -> Table:
    """Read a measured table.

    time: `COLUMN` or `COLUMN:UNIT` with unit s, ms, us, ns or iso (dates; without a time zone they are taken as UTC).
    Without a unit, numbers are seconds and anything else is a date. None: no such column, samples are `period` apart,
    for example `10ms`. command: one column per fan, or one for all. speed: `COLUMN` or `COLUMN:UNIT`, one per fan,
    unit rad/s (the default), rpm, hz (revolutions a second) or deg/s.

    Raises:
        UserError: the file, a column or a unit cannot be used.
    """
    if not speed or len(command) not in (1, len(speed)):
        raise UserError(
            f"{len(command)} command and {len(speed)} speed columns: give --speed once per fan, and --command "
            "once for all fans or once per fan"
        )
    rows = _rows(path)
    names = _names(path, next(rows, []))
    cells = [row + [""] * (len(names) - len(row)) for row in rows if any(row)]
    times, time_without_unit = _times(path, names, cells, time) if time else (_counted_times(len(cells), period), "")
    if time and period:
        raise UserError("--period is for tables without a time column: leave out --time or --period")
    commands = [_numbers(path, names, cells, _column(path, given, names, ())[0]) for given in command]
    speed_columns, units = zip(*(_column(path, given, names, RAD_S_PER_TABLE_UNIT) for given in speed), strict=True)
    if len(set(units)) > 1:
        raise UserError(f"speeds in {', '.join(unit or 'no unit' for unit in units)}: give all in one unit")
    unit = units[0] or "rad/s"
    speeds = [_numbers(path, names, cells, column) * RAD_S_PER_TABLE_UNIT[unit] for column in speed_columns]
    fans_per_command = len(speeds) // len(commands)
    table = _clean(path, times, np.column_stack(commands * fans_per_command), np.column_stack(speeds), unit)
    return replace(table, assumed=_assumed(time_without_unit, "" if units[0] else names[speed_columns[0]]))


def _rows(path: Path) -> Iterator[list[str]]:
    """The rows of the file, header first, without blanks around cells."""
    try:
        with path.open("rb") as file:
            start = file.read(4096)
        is_utf_16 = start.startswith((b"\xff\xfe", b"\xfe\xff"))
        if not is_utf_16 and b"\0" in start:
            raise UserError(f"{path}: not a text file with columns; export it as CSV")
        with path.open(encoding="utf-16" if is_utf_16 else "utf-8-sig", errors="replace", newline="") as file:
            header = file.readline()
            file.seek(0)
            delimiter = max(_DELIMITERS, key=header.count)
            yield from ([cell.strip() for cell in row] for row in csv.reader(file, delimiter=delimiter))
    except OSError as error:
        raise UserError(f"{path}: cannot read the table: {error.strerror}") from error
    except csv.Error as error:
        raise UserError(f"{path}: not a text file with columns: {error}") from error


def _names(path: Path, header: list[str]) -> list[str]:
    names = [name.strip("# \t") for name in header]
    if not any(names):
        raise UserError(f"{path}: the first line must name the columns, but is empty")
    return names


def _column(path: Path, given: str, names: list[str], units: Iterable[str]) -> tuple[int, str]:
    """Index of a column and its unit, empty if none is given; `given` is NAME or NAME:UNIT."""
    name, colon, unit = given.rpartition(":")
    if given in names or not colon:
        name, unit = given, ""
    name = name.strip()
    if name not in names:
        close = difflib.get_close_matches(name, names, n=3, cutoff=0.5)
        hint = f"did you mean {' or '.join(map(repr, close))}?" if close else f"it has {', '.join(filter(None, names))}"
        raise UserError(f"{path}: no column {name!r}; {hint}")
    if names.count(name) > 1:
        raise UserError(f"{path}: {names.count(name)} columns are called {name!r}; rename them in its first line")
    unit, units = unit.strip().lower(), list(units)
    if unit and unit not in units:
        known = f"known: {', '.join(units)}" if units else "a command has no unit"
        raise UserError(f"{given!r}: unknown unit {unit!r}; {known}")
    return names.index(name), unit


def _numbers(path: Path, names: list[str], cells: list[list[str]], column: int) -> Array:
    """A column as float64, NaN where a cell is not a finite number."""
    values = np.array([_number(row[column]) for row in cells], dtype=np.float64)
    values[np.isinf(values)] = np.nan
    if not np.any(np.isfinite(values)):
        example = next((row[column] for row in cells if row[column]), "")
        raise UserError(f"{path}: column {names[column]!r} has no numbers, but for example {example!r}")
    return values


def _number(cell: str) -> float:
    try:
        return float(cell)
    except ValueError:
        if cell.lower() in _NOT_MEASURED:
            return math.nan
    try:
        return float(cell.replace(",", "."))  # decimal comma; possible only where columns are not separated by commas
    except ValueError:
        return math.nan


def _times(path: Path, names: list[str], cells: list[list[str]], given: str) -> tuple[list[int | None], str]:
    """Time of each row in ns, None where it cannot be read; and the column's name if its unit was assumed."""
    column, unit = _column(path, given, names, (*NS_PER_UNIT, DATE_UNIT))
    first = next((row[column] for row in cells if row[column]), "")
    assumed = ""
    if not unit:
        unit = DATE_UNIT if math.isnan(_number(first)) else "s"
        assumed = "" if unit == DATE_UNIT else names[column]
    parse = _date_ns if unit == DATE_UNIT else _count_ns(NS_PER_UNIT[unit])
    times = [parse(row[column]) for row in cells]
    if not any(time is not None for time in times):
        raise UserError(
            f"{path}: column {names[column]!r} has no times in {unit}, but for example {first!r}; "
            "use numbers in s, ms, us or ns, or dates such as 2026-01-31 13:45:00.250"
        )
    if any(time is not None and abs(time) >= FURTHEST_T_NS for time in times):
        name, finer = names[column], _FINER_UNIT.get(unit)
        hint = f"is it in ms, us or ns? use --time {name}:{finer}" if finer else "choose another time column"
        raise UserError(f"{path}: column {name!r} in {unit} gives times beyond the year 2116: {hint}")
    return times, assumed


def _assumed(time: str, speed: str) -> str:
    """Which units were assumed, in one line. time, speed: name of the column without a unit, else empty."""
    found = [
        (what, f"{option} {shlex.quote(f'{name}:{other}')}")
        for name, what, option, other in (
            (time, "times in s", "--time", "ms"),
            (speed, "speeds in rad/s", "--speed", "rpm"),
        )
        if name
    ]
    if not found:
        return ""
    assumed, options = (" and ".join(words) for words in zip(*found, strict=True))
    return f"no unit given, {assumed} assumed; if that is wrong, use for example {options}"


def _counted_times(rows: int, period: str | None) -> list[int | None]:
    """Times of a table without a time column: rows `period` apart, from 0."""
    if period is None:
        raise UserError("a table needs --time COLUMN[:UNIT], or --period 10ms if it has no time column")
    match = re.fullmatch(r"(\d+\.?\d*|\.\d+)\s*(s|ms|us|ns)", period.strip())
    period_ns = round(float(match[1]) * NS_PER_UNIT[match[2]]) if match else 0
    if period_ns <= 0:
        raise UserError(f"--period {period}: give the time between samples with its unit, for example 10ms")
    return [row * period_ns for row in range(rows)]


def _count_ns(scale: int) -> Callable[[str], int | None]:
    def parse(cell: str) -> int | None:
        try:
            return int(cell) * scale  # exact: a float cannot hold ns since 1970
        except ValueError:
            value = _number(cell) * scale
            return round(value) if math.isfinite(value) else None

    return parse


def _date_ns(cell: str) -> int | None:
    try:
        date = datetime.fromisoformat(_DATE_AND_FRACTION.sub(r"\1.\2", cell))
    except ValueError:
        return None
    since = (date if date.tzinfo else date.replace(tzinfo=UTC)) - _UNIX_EPOCH
    return since // timedelta(microseconds=1) * 1000


def _clean(path: Path, times: list[int | None], command: Array, speed_rad_s: Array, unit: str) -> Table:
    """Sort rows by time, hold commands, merge rows of the same time, and count all of it."""
    rows = len(times)
    timed = [row for row, time in enumerate(times) if time is not None]
    t_ns = np.array([times[row] for row in timed], dtype=np.int64)
    behind_ns = np.maximum.accumulate(t_ns) - t_ns
    if np.any(behind_ns > OUT_OF_ORDER_NS):
        first = int(np.argmax(behind_ns > OUT_OF_ORDER_NS))
        raise UserError(
            f"{path}: time goes back by {behind_ns[first] / NS_PER_S:.3f} s at row {timed[first] + 1}, as if the "
            "clock had been set: choose another time column, or cut the file there"
        )
    order = np.argsort(t_ns, kind="stable")
    t_ns, command, speed_rad_s = t_ns[order], command[timed][order], speed_rad_s[timed][order]
    held_command = hold_last(command)
    known = ~np.any(np.isnan(held_command), axis=1)
    t_ns, command, held_command, speed_rad_s = t_ns[known], command[known], held_command[known], speed_rad_s[known]
    first = np.flatnonzero(np.diff(t_ns, prepend=t_ns[:1] - 1))
    if len(first) < 2:
        raise UserError(f"{path}: fewer than two rows with a time and a command")
    last = np.append(first[1:], len(t_ns)) - 1
    repairs = Repairs(
        rows=rows,
        without_time=rows - len(timed),
        out_of_order=int(np.count_nonzero(behind_ns)),
        repeated=len(t_ns) - len(first),
        before_command=int(np.count_nonzero(~known)),
        commands_held=int(np.count_nonzero(np.isnan(command))),
        speeds_missing=int(np.count_nonzero(np.isnan(speed_rad_s))),
    )
    return Table(path, t_ns[first], held_command[last], _means(speed_rad_s, first), unit, repairs)


def hold_last(command: Array) -> Array:
    """(n, fans) with each NaN replaced by the last value before it; NaN remains where there is none."""
    rows = np.arange(len(command))[:, np.newaxis]
    known = np.maximum.accumulate(np.where(np.isnan(command), 0, rows), axis=0)
    return np.take_along_axis(command, known, axis=0)


def _means(speed_rad_s: Array, first: Array) -> Array:
    """Mean speed of each group of rows that begins at `first`, ignoring NaN; NaN if all are."""
    measured = np.isfinite(speed_rad_s)
    counts = np.add.reduceat(measured, first, axis=0, dtype=np.int64)
    sums = np.add.reduceat(np.where(measured, speed_rad_s, 0.0), first, axis=0)
    return np.divide(sums, counts, out=np.full(sums.shape, np.nan), where=counts > 0)
