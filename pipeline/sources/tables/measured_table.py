"""Measured tables: a text file with columns, as a logger wrote it, to samples with strictly increasing times.

How a file holds its table is found in `layout`, numbers in `numbers`, times in `times`; rows out of order, repeated
times and empty cells are handled here. Every change to the data is counted (`Repairs`).

pandas would replace only the reading of cells, and every installation would need it.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import astuple, dataclass, field, replace
from itertools import islice
from pathlib import Path

import numpy as np

from fantwin.pipeline.errors import UsageError, UserError
from fantwin.pipeline.sources.tables.clocks import continued, goes_back, time_in_words
from fantwin.pipeline.sources.tables.fan_columns import FanColumns, fan_columns
from fantwin.pipeline.sources.tables.layout import Layout, find_layout, rows_of
from fantwin.pipeline.sources.tables.numbers import NumberColumn, OtherMarkError
from fantwin.pipeline.sources.tables.profiles import profile_of
from fantwin.pipeline.sources.tables.times import TimeColumn, time_names, usual_time
from fantwin.pipeline.sources.tables.units import (
    ELECTRICAL,
    ELECTRICAL_HUNDREDS,
    NS_PER_UNIT,
    RAD_S_PER_TABLE_UNIT,
    SPEED_UNITS,
    scale_of,
)
from fantwin.schemas.channels import BY_NAME
from fantwin.schemas.messages import FURTHEST_T_NS, LARGEST_PERIOD_NS, Array
from fantwin.schemas.units import NS_PER_S

GAP_IN_MEDIAN_PERIODS = 5.0

_ROWS_IN_PART = 4096
NO_COLUMNS: Mapping[str, Sequence[str]] = {}


@dataclass(frozen=True)
class Reading:
    """What a user says of a file that does not show it; empty: it is found.

    Attributes:
        dates: order of the parts of a date, dmy, mdy or ymd.
        zone: time zone of dates without one.
        decimal: decimal mark of the numbers.
        poles: magnetic poles of the motors, for electrical speeds.
    """

    dates: str = ""
    zone: str = ""
    decimal: str = ""
    poles: int | None = None


AS_FOUND = Reading()


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

    def plus(self, *others: Repairs) -> Repairs:
        """The counts of several tables together."""
        return Repairs(*(sum(counts) for counts in zip(*map(astuple, (self, *others)), strict=True)))


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
    remarks: tuple[str, ...] = ()
    """notes on how it was read, a line each"""
    has_dates: bool = False
    """whether times are since 1970"""

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
            (
                self.gaps,
                f"gaps longer than {period_in_words(GAP_IN_MEDIAN_PERIODS * self.median_period_s)}, not filled",
            ),
        )
        notes = [*self.remarks, *(f"{count} {text}" for count, text in counts if count)]
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
    reading: Reading = AS_FOUND,
    layout: Layout | None = None,
) -> Table:
    """Read a measured table.

    time: `COLUMN`, `COLUMN:UNIT` with unit s, ms, us, ns or iso (dates), or `DATE+TIME`, two columns; see `TimeColumn`.
    None: the one that the names and cells show, or with `period`, for example `10ms`, none. command, speed, auxiliary:
    as for `fan_columns`; the unit of speeds is the one that is given, else the one in the file, else rad/s. layout: of
    the file, if it was found before.

    Raises:
        UserError: the file, a column or a unit cannot be used.
    """
    if time and period:
        raise UsageError("--period is for tables without a time column: leave out --time or --period")
    if reading.decimal not in ("", ".", ","):
        raise UsageError(f"--decimal {reading.decimal}: give . or ,")
    layout = layout or find_layout(path)
    profile = profile_of(layout)
    chosen = fan_columns(path, layout.all_names, command, speed, auxiliary, SPEED_UNITS)
    time = time or (not period and ((profile and profile.time_in(layout)) or usual_time(layout))) or None
    if not (time or period):
        raise UsageError("a table needs --time COLUMN[:UNIT], or --period 10ms if it has no time column")
    dates = reading.dates or (profile.dates if profile else "")
    times, columns, count = _columns(layout, time, chosen, replace(reading, dates=dates))
    t_ns, has_time = times.values() if times else _counted_times(count, period or "")
    values = {name: column.values(may_be_empty=chosen.is_pattern) for name, column in columns.items()}
    chosen, left_out = used_fans(path, chosen, values)
    remarks = [*_twice(layout, chosen), *chosen.notes, *left_out]
    if times:
        words = (times.format,) if times.is_notable else ()
        remarks = [*(f"times of {times.name!r}: {each}" for each in words), *times.notes, *remarks]
    remarks += [f"{column.name!r}: {texts}" for column in columns.values() if (texts := column.texts(has_time))]
    for channel, names in chosen.others.items():
        for name in filter(None, dict.fromkeys(names)):
            remarks += _in_unit_of(channel, name, layout.unit(name) or columns[name].unit, values)
    unit = chosen.unit or _unit_in_file(
        chosen, {name: layout.unit(name) or columns[name].unit for name in chosen.speed}
    )
    if profile:
        unit, words = profile.unit_of(chosen.speed, unit)
        remarks += words
    table = table_of(path, chosen, values, t_ns, has_time, *rad_s_per(unit or "rad/s", reading.poles))
    return replace(
        table,
        assumed=_assumed(times, replace(chosen, assumed="" if unit else chosen.assumed)),
        remarks=(*remarks, *table.remarks),
        has_dates=bool(times and times.has_dates),
    )


def read_columns(
    layout: Layout, time: str | None, reading: Reading
) -> tuple[dict[str, NumberColumn], list[str], list[str]]:
    """All columns of a table that have numbers, the times in words, and what cannot be told of them."""
    profile = profile_of(layout)
    time = time or (profile and profile.time_in(layout)) or usual_time(layout)
    reading = replace(reading, dates=reading.dates or (profile.dates if profile else ""))
    of_time = time_names(layout, time)[0] if time else []
    numbers = [name for name, kind in zip(layout.names, layout.kinds, strict=True) if kind == "number"]
    names = tuple(name for name in numbers if name and name not in of_time)
    chosen = FanColumns(names, (), {}, "", "", ())
    notes: list[str] = []
    try:
        times, columns, count = _columns(layout, time, chosen, reading)
    except UserError as error:
        notes.append(str(error))
        times, columns, count = _columns(layout, None, chosen, reading)
    words: list[str] = [] if time else ["no column of times: give --period 1s, the time between rows"]
    if times:
        try:
            t_ns, known = times.values()
            words = [f"times: {times.name}, {times.format}, {_range_of_times(t_ns[known])}", *times.notes]
        except UserError as error:
            notes.append(str(error))
    for name in list(columns):
        try:
            columns[name].check()
        except UserError as error:
            notes.append(str(error))
            del columns[name]
    return columns, [*words, f"{count} rows"], notes


def _range_of_times(t_ns: Array) -> str:
    steps = np.diff(t_ns)
    usual = float(np.median(steps)) / NS_PER_S if len(steps) else 0.0
    ends = f"from {time_in_words(int(t_ns.min()))} to {time_in_words(int(t_ns.max()))}"
    return f"{period_in_words(usual)} apart (median), {ends}"


def period_in_words(seconds: float) -> str:
    """A time between samples to three digits: 2 s, 12.5 ms."""
    for unit, size in (("s", 1.0), ("ms", 1e-3)):
        if seconds >= 0.9995 * size:
            value = seconds / size
            return f"{value:.0f} {unit}" if value >= 100 else f"{value:.3g} {unit}"
    return f"{seconds * 1e6:.3g} us"


def _columns(
    layout: Layout, time: str | None, chosen: FanColumns, reading: Reading
) -> tuple[TimeColumn | None, dict[str, NumberColumn], int]:
    """The columns with their cells, and the number of rows."""
    shown: dict[str, str] = {}
    of_times = ""
    while True:
        times = TimeColumn(layout, time, reading.dates, reading.zone, reading.decimal or of_times) if time else None
        columns = {
            name: NumberColumn(
                layout.path,
                name,
                layout.index(name),
                reading.decimal or shown.get(name) or layout.decimal_of(name),
                is_final=bool(reading.decimal) or name in shown,
            )
            for name in chosen.names
        }
        count = 0
        try:
            for part in _parts(rows_of(layout)):
                for column in (*filter(None, [times]), *columns.values()):
                    column.add(part)
                count += len(part)
        except OtherMarkError as found:
            if times and found.name == times.name:
                of_times = found.decimal
            else:
                shown[found.name] = found.decimal
        else:
            return times, columns, count


def _twice(layout: Layout, chosen: FanColumns) -> list[str]:
    """Notes on columns that were asked for by a name that several have."""
    asked = [name for name in chosen.names if f"{name} [2]" in layout.names]
    return [f"several columns are called {name!r}: the first is read; the next is {f'{name} [2]'!r}" for name in asked]


def _unit_in_file(chosen: FanColumns, units: Mapping[str, str]) -> str:
    """The unit of speeds that the file shows; empty: none."""
    found = list(dict.fromkeys(unit if unit in SPEED_UNITS else "" for unit in units.values()))
    if len(found) > 1:
        raise UsageError(
            f"speeds in {', '.join(unit or 'no unit' for unit in found)}, as the file says: give one unit, as in "
            f"--speed {shlex.quote(f'{chosen.speed[0]}:rpm')}, or import them apart"
        )
    return found[0]


def _in_unit_of(channel: str, name: str, unit: str, values: Mapping[str, Array]) -> list[str]:
    """Convert a column to the unit of its channel, in place; a note where its unit is another kind of unit."""
    if not unit:
        return []
    scale = scale_of(channel, unit)
    if scale is None:
        return [f"{name!r} is in {unit}, and is taken as {channel}, in {BY_NAME[channel].unit}"]
    if scale.factor != 1.0 or scale.offset:
        values[name][:] = values[name] * scale.factor + scale.offset
        return [f"{name!r} converted from {unit} to {BY_NAME[channel].unit}"]
    return []


def rad_s_per(unit: str, poles: int | None) -> tuple[float, str]:
    """rad/s of one unit, and the unit that people are shown. poles: magnetic ones, for electrical speeds."""
    if unit not in (ELECTRICAL, ELECTRICAL_HUNDREDS):
        return RAD_S_PER_TABLE_UNIT[unit], unit
    if poles is None:
        raise UsageError(
            "speeds in erpm are electrical revolutions: give the magnetic poles of the motor, for example --poles 14"
        )
    if poles < 2 or poles % 2:
        raise UsageError(f"--poles {poles}: magnetic poles come in pairs, for example 14")
    return (100.0 if unit == ELECTRICAL_HUNDREDS else 1.0) * RAD_S_PER_TABLE_UNIT["rpm"] / (poles / 2), "rpm"


def used_fans(path: Path, chosen: FanColumns, values: Mapping[str, Array]) -> tuple[FanColumns, list[str]]:
    """The columns of the fans of a pattern that ever turned and had a command, and a note on the others.

    Boards and flight controllers log slots that nothing is connected to. Fans that were named are kept.

    Raises:
        UserError: none is left.
    """
    if not chosen.is_pattern:
        return chosen, []
    turned = [bool(np.any(np.nan_to_num(values[name]) != 0)) for name in chosen.speed]
    told = [bool(np.any(np.isfinite(values[name]))) for name in chosen.command]
    used = [k for k, both in enumerate(zip(turned, told, strict=True)) if all(both)]
    if not used:
        raise UserError(f"{path}: no fan of {chosen.speed[0]} and others ever turns")
    unused = [name for k, name in enumerate(chosen.speed) if k not in used]
    if not unused:
        return chosen, []
    picked = {channel: tuple(names[k] for k in used) for channel, names in chosen.others.items()}
    command, speed = (tuple(names[k] for k in used) for names in (chosen.command, chosen.speed))
    more = f" and {len(unused) - 3} more" if len(unused) > 3 else ""
    note = f"left out, because the speed is always 0 or missing: {', '.join(unused[:3])}{more}"
    return replace(chosen, command=command, speed=speed, others=picked), [note]


def table_of(
    path: Path,
    chosen: FanColumns,
    values: Mapping[str, Array],
    t_ns: Array,
    has_time: Array,
    rad_s_per_unit: float,
    unit: str,
    *,
    longest_part: bool = False,
) -> Table:
    """The samples of fans from columns. values: (n,) of each column by its name; a channel without one is NaN. t_ns,
    has_time, unit, longest_part: as for `clean_samples`. rad_s_per_unit: of the values of speed."""
    unknown = np.full(len(t_ns), np.nan)
    command, speed, *others = (
        np.column_stack([values[name] if name else unknown for name in names])
        for names in (chosen.command, chosen.speed, *chosen.others.values())
    )
    speed *= rad_s_per_unit
    table = clean_samples(
        path, t_ns, has_time, command, np.column_stack([speed, *others]), unit, longest_part=longest_part
    )
    of_speed, *measured = np.split(table.speed_rad_s, len(others) + 1, axis=1)
    return replace(table, speed_rad_s=of_speed, auxiliary=dict(zip(chosen.others, measured, strict=True)))


def _parts(rows: Iterator[list[str]]) -> Iterator[list[list[str]]]:
    """The rows, some thousand at a time."""
    while part := list(islice(rows, _ROWS_IN_PART)):
        yield part


def _assumed(times: TimeColumn | None, chosen: FanColumns) -> str:
    """Line on the units that were assumed."""
    found = [
        each for each in (times.assumed if times else None, ("speeds in rad/s", chosen.assumed)) if each and each[1]
    ]
    if not found:
        return ""
    assumed, options = (" and ".join(words) for words in zip(*found, strict=True))
    return f"no unit given, {assumed} assumed; if that is wrong, use for example {options}"


def _counted_times(rows: int, period: str) -> tuple[Array, Array]:
    """Times of a table without a time column: rows `period` apart, from 0; all are known."""
    match = re.fullmatch(r"(\d{1,9}\.?\d*|\.\d+)\s*(s|ms|us|ns)", period.strip())
    period_ns = round(float(match[1]) * NS_PER_UNIT[match[2]]) if match else 0
    if not 0 < period_ns <= LARGEST_PERIOD_NS:
        raise UsageError(f"--period {period}: give the time between samples with its unit, for example 10ms")
    if rows * period_ns >= FURTHEST_T_NS:
        raise UsageError(f"--period {period}: the table would end beyond the year 2116; give a shorter period")
    return np.arange(rows, dtype=np.int64) * period_ns, np.ones(rows, dtype=np.bool_)


def clean_samples(
    path: Path,
    t_ns: Array,
    has_time: Array,
    command: Array,
    speed_rad_s: Array,
    unit: str,
    *,
    longest_part: bool = False,
) -> Table:
    """Sort rows by time, hold commands, merge rows of the same time, and count all of it. speed_rad_s: and after the
    columns of the fans any others that may be missing, which are treated alike. longest_part: as for `continued`.

    A step that changes nothing copies nothing: most tables are in order and may be large.
    """
    rows = len(t_ns)
    if not has_time.all():
        t_ns, command, speed_rad_s = t_ns[has_time], command[has_time], speed_rad_s[has_time]
    clock = continued(path, t_ns, np.flatnonzero(has_time), longest_part=longest_part)
    t_ns = clock.t_ns
    if not clock.is_good.all():
        t_ns, command, speed_rad_s = t_ns[clock.is_good], command[clock.is_good], speed_rad_s[clock.is_good]
    out_of_order = 0
    if goes_back(t_ns):
        out_of_order = int(np.count_nonzero(np.maximum.accumulate(t_ns) - t_ns))
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
    return Table(path, t_ns, held, speed_rad_s, unit, repairs, remarks=clock.notes)


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
