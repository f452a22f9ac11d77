"""Reading of a measured table: its columns, its times and its units become samples of fans.

How a file holds its table is found in `layout`, its numbers in `numbers`, its times in `times`. pandas would replace
only the reading of cells, and every installation would need it.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path

import numpy as np

from fantwin.pipeline.errors import UsageError, UserError
from fantwin.pipeline.sources.tables.clocks import time_in_words
from fantwin.pipeline.sources.tables.fan_columns import FanColumns, fan_columns
from fantwin.pipeline.sources.tables.layout import Layout, find_layout, rows_of
from fantwin.pipeline.sources.tables.measured_table import (
    NO_COLUMNS,
    Table,
    constant_commands,
    period_in_words,
    rad_s_per,
    table_of,
    used_fans,
)
from fantwin.pipeline.sources.tables.numbers import NumberColumn, OtherMarkError
from fantwin.pipeline.sources.tables.profiles import profile_of
from fantwin.pipeline.sources.tables.times import TimeColumn, time_names, usual_time
from fantwin.pipeline.sources.tables.units import NS_PER_UNIT, SPEED_UNITS, scale_of
from fantwin.schemas.channels import BY_NAME
from fantwin.schemas.messages import FURTHEST_T_NS, LARGEST_PERIOD_NS, Array
from fantwin.schemas.units import NS_PER_S

_ROWS_IN_PART = 4096


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
    times, columns, count, wider = columns_of(layout, time, chosen, replace(reading, dates=dates))
    t_ns, has_time = times.values() if times else _counted_times(count, period or "")
    values = {name: column.values(may_be_empty=chosen.is_pattern) for name, column in columns.items()}
    chosen, left_out = used_fans(path, chosen, values)
    remarks = [*([] if layout.head == 1 else [layout.in_words]), *_twice(layout, chosen), *chosen.notes, *left_out]
    if wider:
        remarks.append(f"{len(wider)} rows left out: more cells than the {len(layout.names)} names, first {wider[0]!r}")
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
        remarks=(*remarks, *table.remarks, *constant_commands(chosen, table.command)),
        has_dates=bool(times and times.has_dates),
    )


def read_columns(
    layout: Layout, time: str | None, reading: Reading
) -> tuple[dict[str, NumberColumn], list[str], list[str]]:
    """All columns of a table that have numbers, the times in words, and what cannot be told of them."""
    time, reading, chosen = _all_numbers(layout, time, reading)
    notes: list[str] = []
    try:
        times, columns, count, _ = columns_of(layout, time, chosen, reading)
    except UserError as error:
        notes.append(str(error))
        times, columns, count, _ = columns_of(layout, None, chosen, reading)
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


def series_in(layout: Layout, time: str | None, reading: Reading) -> dict[str, tuple[Array, Array]]:
    """Times and values of all columns of a table that have numbers, of the rows in which they have one.

    Raises:
        UserError: it has no times, or they cannot be read.
    """
    time, reading, chosen = _all_numbers(layout, time, reading)
    if not time:
        raise UserError(f"{layout.path}: no column of times; name it with --time")
    times, columns, _, _ = columns_of(layout, time, chosen, reading)
    assert times
    t_ns, known = times.values()
    found: dict[str, tuple[Array, Array]] = {}
    for name, column in columns.items():
        values = column.values(may_be_empty=True)
        rows = known & np.isfinite(values)
        found[name] = t_ns[rows], values[rows]
    return found


def _all_numbers(layout: Layout, time: str | None, reading: Reading) -> tuple[str, Reading, FanColumns]:
    """The time column of a table, how it is read, and all its columns of numbers."""
    profile = profile_of(layout)
    time = time or (profile and profile.time_in(layout)) or usual_time(layout)
    of_time = time_names(layout, time)[0] if time else []
    numbers = [name for name, kind in zip(layout.names, layout.kinds, strict=True) if kind == "number"]
    names = tuple(name for name in numbers if name and name not in of_time)
    dates = reading.dates or (profile.dates if profile else "")
    return time, replace(reading, dates=dates), FanColumns(names, (), {}, "", "", ())


def _range_of_times(t_ns: Array) -> str:
    steps = np.diff(t_ns)
    usual = float(np.median(steps)) / NS_PER_S if len(steps) else 0.0
    ends = f"from {time_in_words(int(t_ns.min()))} to {time_in_words(int(t_ns.max()))}"
    return f"{period_in_words(usual)} apart (median), {ends}"


def columns_of(
    layout: Layout, time: str | None, chosen: FanColumns, reading: Reading
) -> tuple[TimeColumn | None, dict[str, NumberColumn], int, list[str]]:
    """The columns with their cells, the number of rows, and what other rows have beyond the last name."""
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
        wider: list[str] = []
        try:
            for part in _parts(rows_of(layout, wider)):
                for column in (*filter(None, [times]), *columns.values()):
                    column.add(part)
                count += len(part)
        except OtherMarkError as found:
            if times and found.name == times.name:
                of_times = found.decimal
            else:
                shown[found.name] = found.decimal
        else:
            return times, columns, count, wider


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
