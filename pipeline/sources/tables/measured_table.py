"""Measured tables: a text file with columns, as a logger wrote it, to samples with strictly increasing times.

Rows out of order, repeated times and empty cells are handled here, for tables and logs. Every change to the data is
counted (`Repairs`). How a file is read: `table_file`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import astuple, dataclass, field, replace
from pathlib import Path

import numpy as np

from fantwin.pipeline.errors import UsageError, UserError
from fantwin.pipeline.sources.tables.clocks import continued, goes_back
from fantwin.pipeline.sources.tables.fan_columns import FanColumns
from fantwin.pipeline.sources.tables.units import (
    ELECTRICAL,
    ELECTRICAL_HUNDREDS,
    RAD_S_PER_TABLE_UNIT,
)
from fantwin.schemas.messages import Array
from fantwin.schemas.units import NS_PER_S

GAP_IN_MEDIAN_PERIODS = 5.0

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


def period_in_words(seconds: float) -> str:
    """A time between samples to three digits: 2 s, 12.5 ms."""
    for unit, size in (("s", 1.0), ("ms", 1e-3)):
        if seconds >= 0.9995 * size:
            value = seconds / size
            return f"{value:.0f} {unit}" if value >= 100 else f"{value:.3g} {unit}"
    return f"{seconds * 1e6:.3g} us"


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
    return replace(
        table,
        speed_rad_s=of_speed,
        auxiliary=dict(zip(chosen.others, measured, strict=True)),
    )


def constant_commands(chosen: FanColumns, command: Array) -> list[str]:
    """A note on each command (n, fans) that never changes, from which no twin can be made."""
    never = dict.fromkeys(
        (name, float(command[0, fan]))
        for fan, name in enumerate(chosen.command)
        if not np.any(np.diff(command[:, fan]))
    )
    return [f"{name} is {value:g} throughout: a twin needs steps of the command" for name, value in never]


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
    clock = continued(path, t_ns, has_time, longest_part=longest_part)
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
