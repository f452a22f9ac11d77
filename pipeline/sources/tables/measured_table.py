"""Measured tables: a text file with columns, as a logger wrote it, to samples with strictly increasing times.

Irregularities of real files are handled here and nowhere else: a byte-order mark and blanks in column names; commas,
semicolons or tabs between columns; decimal commas; times as numbers or dates; rows out of order, repeated times, empty
cells. Every change to the data is counted (`Repairs`).

pandas would replace only the reading of cells, and every installation would need it.
"""

from __future__ import annotations

import csv
import math
import re
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import TextIO

import numpy as np

from fantwin.pipeline.errors import UsageError, UserError
from fantwin.pipeline.sources.tables.cells import DATE_UNIT, NS_PER_UNIT, NumberColumn, TimeColumn
from fantwin.pipeline.sources.tables.fan_columns import FanColumns, fan_columns, require, with_unit
from fantwin.schemas.messages import FURTHEST_T_NS, LARGEST_PERIOD_NS, Array
from fantwin.schemas.units import NS_PER_S, RAD_S_PER_UNIT

RAD_S_PER_TABLE_UNIT = {**RAD_S_PER_UNIT, "hz": 2 * math.pi, "deg/s": math.pi / 180}
GAP_IN_MEDIAN_PERIODS = 5.0
OUT_OF_ORDER_NS = NS_PER_S  # rows further back than this mean that the clock was set

_DELIMITERS = ",;\t"
LONGEST_LINE = 1 << 20
"""characters"""
_ROWS_IN_PART = 4096
NO_COLUMNS: Mapping[str, Sequence[str]] = {}


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
    """units and time zone that were assumed, and how to give units, in one line; empty if all were given"""
    auxiliary: Mapping[str, Array] = field(default_factory=dict[str, Array])
    """other measured columns, (n, fans) each, NaN where missing, by name in schemas.channels"""

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
        """Notes for people, one line per kind of irregularity."""
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
    path: Path,
    time: str | None,
    command: Sequence[str],
    speed: Sequence[str],
    *,
    period: str | None = None,
    auxiliary: Mapping[str, Sequence[str]] = NO_COLUMNS,
) -> Table:
    """Read a measured table.

    time: `COLUMN` or `COLUMN:UNIT` with unit s, ms, us, ns or iso (dates; without a time zone they are taken as UTC).
    Without a unit, numbers are seconds and anything else is a date. None: no such column, samples are `period` apart,
    for example `10ms`. command, speed, auxiliary: as for `fan_columns`; the unit of speeds is rad/s (the default), rpm,
    hz (revolutions a second) or deg/s.

    Raises:
        UserError: the file, a column or a unit cannot be used.
    """
    if time and period:
        raise UsageError("--period is for tables without a time column: leave out --time or --period")
    if not (time or period):
        raise UsageError("a table needs --time COLUMN[:UNIT], or --period 10ms if it has no time column")
    rows = _rows(path)
    names = _names(path, next(rows, []))
    times = _time_column(path, time, names) if time else None
    chosen = fan_columns(path, names, command, speed, auxiliary, RAD_S_PER_TABLE_UNIT)
    columns = {name: NumberColumn(path, name, names.index(name)) for name in chosen.names}
    count = 0
    for part in _parts(rows, len(names)):
        for column in (*filter(None, [times]), *columns.values()):
            column.add(part)
        count += len(part)
    t_ns, has_time = times.values() if times else _counted_times(count, period or "")
    values = {name: column.values() for name, column in columns.items()}
    unit = chosen.unit or "rad/s"
    table = table_of(path, chosen, values, t_ns, has_time, RAD_S_PER_TABLE_UNIT[unit], unit)
    return replace(table, assumed=_assumed(times, chosen))


def table_of(
    path: Path,
    chosen: FanColumns,
    values: Mapping[str, Array],
    t_ns: Array,
    has_time: Array,
    rad_s_per_unit: float,
    unit: str,
) -> Table:
    """The samples of fans from columns. values: (n,) of each column by its name; a channel without one is NaN. t_ns,
    has_time, unit: as for `clean_samples`. rad_s_per_unit: of the values of speed."""
    unknown = np.full(len(t_ns), np.nan)
    command, speed, *others = (
        np.column_stack([values[name] if name else unknown for name in names])
        for names in (chosen.command, chosen.speed, *chosen.others.values())
    )
    speed *= rad_s_per_unit
    table = clean_samples(path, t_ns, has_time, command, np.column_stack([speed, *others]), unit)
    of_speed, *measured = np.split(table.speed_rad_s, len(others) + 1, axis=1)
    return replace(table, speed_rad_s=of_speed, auxiliary=dict(zip(chosen.others, measured, strict=True)))


def _parts(rows: Iterator[list[str]], width: int) -> Iterator[list[list[str]]]:
    """The rows that are not empty, some thousand at a time, each at least `width` cells wide."""
    filled = (row + [""] * (width - len(row)) for row in rows if any(row))
    while part := list(islice(filled, _ROWS_IN_PART)):
        yield part


def _rows(path: Path) -> Iterator[list[str]]:
    """The rows of the file, header first, without blanks around cells."""
    try:
        with path.open("rb") as file:
            start = file.read(4096)
        is_utf_16 = start.startswith((b"\xff\xfe", b"\xfe\xff"))
        if not is_utf_16 and b"\0" in start:
            raise UserError(f"{path}: not a text file with columns; export it as CSV")
        with path.open(encoding="utf-16" if is_utf_16 else "utf-8-sig", errors="replace", newline="") as file:
            header = file.readline(LONGEST_LINE)
            file.seek(0)
            delimiter = max(_DELIMITERS, key=header.count)
            yield from ([cell.strip() for cell in row] for row in csv.reader(_lines(path, file), delimiter=delimiter))
    except OSError as error:
        raise UserError(f"{path}: cannot read the table: {error.strerror}") from error
    except csv.Error as error:
        raise UserError(f"{path}: not a text file with columns: {error}") from error


def _lines(path: Path, file: TextIO) -> Iterator[str]:
    while line := file.readline(LONGEST_LINE):
        if len(line) == LONGEST_LINE:
            raise UserError(f"{path}: not a text file with columns: a line is longer than {LONGEST_LINE:,} characters")
        yield line


def _names(path: Path, header: list[str]) -> list[str]:
    names = [name.strip("# \t") for name in header]
    if not any(names):
        raise UserError(f"{path}: the first line must name the columns, but is empty")
    return names


def _time_column(path: Path, given: str, names: list[str]) -> TimeColumn:
    name, unit = with_unit(given, names, (*NS_PER_UNIT, DATE_UNIT))
    require(path, names, name)
    return TimeColumn(path, name, names.index(name), unit)


def _assumed(times: TimeColumn | None, chosen: FanColumns) -> str:
    """Line on the units and the time zone that were assumed."""
    found: list[tuple[str, str]] = []
    if times and times.is_assumed:
        found.append(("times in s", f"--time {shlex.quote(f'{times.name}:ms')}"))
    if chosen.assumed:
        found.append(("speeds in rad/s", chosen.assumed))
    lines: list[str] = []
    if found:
        assumed, options = (" and ".join(words) for words in zip(*found, strict=True))
        lines.append(f"no unit given, {assumed} assumed; if that is wrong, use for example {options}")
    if times and times.lacks_zone:
        lines.append(f"dates of {times.name!r} have no time zone: UTC assumed")
    return "; ".join(lines)


def _counted_times(rows: int, period: str) -> tuple[Array, Array]:
    """Times of a table without a time column: rows `period` apart, from 0; all are known."""
    match = re.fullmatch(r"(\d{1,9}\.?\d*|\.\d+)\s*(s|ms|us|ns)", period.strip())
    period_ns = round(float(match[1]) * NS_PER_UNIT[match[2]]) if match else 0
    if not 0 < period_ns <= LARGEST_PERIOD_NS:
        raise UsageError(f"--period {period}: give the time between samples with its unit, for example 10ms")
    if rows * period_ns >= FURTHEST_T_NS:
        raise UsageError(f"--period {period}: the table would end beyond the year 2116; give a shorter period")
    return np.arange(rows, dtype=np.int64) * period_ns, np.ones(rows, dtype=np.bool_)


def clean_samples(path: Path, t_ns: Array, has_time: Array, command: Array, speed_rad_s: Array, unit: str) -> Table:
    """Sort rows by time, hold commands, merge rows of the same time, and count all of it. speed_rad_s: and after the
    columns of the fans any others that may be missing, which are treated alike.

    A step that changes nothing copies nothing: most tables are in order and may be large.
    """
    rows = len(t_ns)
    if not has_time.all():
        t_ns, command, speed_rad_s = t_ns[has_time], command[has_time], speed_rad_s[has_time]
    behind_ns = np.maximum.accumulate(t_ns) - t_ns
    if np.any(behind_ns > OUT_OF_ORDER_NS):
        first = int(np.argmax(behind_ns > OUT_OF_ORDER_NS))
        row = int(np.flatnonzero(has_time)[first])
        raise UserError(
            f"{path}: time goes back by {behind_ns[first] / NS_PER_S:.3f} s at row {row + 1}, as if the "
            "clock had been set: choose another time column, or cut the file there"
        )
    out_of_order = int(np.count_nonzero(behind_ns))
    del behind_ns
    if out_of_order:
        order = np.argsort(t_ns, kind="stable")
        t_ns, command, speed_rad_s = t_ns[order], command[order], speed_rad_s[order]
    commands_held = int(np.count_nonzero(np.isnan(command)))
    held = hold_last(command) if commands_held else command
    known = ~np.any(np.isnan(held), axis=1)
    before_command = int(np.count_nonzero(~known))
    if before_command:
        commands_held = int(np.count_nonzero(np.isnan(command[known])))
        t_ns, held, speed_rad_s = t_ns[known], held[known], speed_rad_s[known]
    first = np.flatnonzero(np.diff(t_ns, prepend=t_ns[:1] - 1))
    if len(first) < 2:
        raise UserError(f"{path}: fewer than two rows with a time and a command")
    speeds_missing = int(np.count_nonzero(np.isnan(speed_rad_s[:, : command.shape[1]])))
    repeated = len(t_ns) - len(first)
    if repeated:
        last = np.append(first[1:], len(t_ns)) - 1
        t_ns, held, speed_rad_s = t_ns[first], held[last], _means(speed_rad_s, first)
    repairs = Repairs(
        rows=rows,
        without_time=rows - int(np.count_nonzero(has_time)),
        out_of_order=out_of_order,
        repeated=repeated,
        before_command=before_command,
        commands_held=commands_held,
        speeds_missing=speeds_missing,
    )
    return Table(path, t_ns, held, speed_rad_s, unit, repairs)


def hold_last(command: Array) -> Array:
    """Replace each NaN by the last value before it, (n, fans); NaN remains where there is none."""
    rows = np.arange(len(command))[:, np.newaxis]
    known = np.maximum.accumulate(np.where(np.isnan(command), 0, rows), axis=0)
    return np.take_along_axis(command, known, axis=0)


def _means(speed_rad_s: Array, first: Array) -> Array:
    """Mean speed of each group of rows that begins at `first`, ignoring NaN; NaN if all are."""
    measured = np.isfinite(speed_rad_s)
    counts = np.add.reduceat(measured, first, axis=0, dtype=np.int64)
    sums = np.add.reduceat(np.where(measured, speed_rad_s, 0.0), first, axis=0)
    return np.divide(sums, counts, out=np.full(sums.shape, np.nan), where=counts > 0)
