"""Measured tables: a text file with columns, as a logger wrote it, to samples with strictly increasing times.

Rows out of order, repeated times and empty cells are handled here, for tables and logs. Every change to the data is
counted (`Repairs`). How a file is read: `table_file`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import astuple, dataclass, field, fields
from pathlib import Path

import numpy as np

from fantwin.pipeline.errors import UserError
from fantwin.pipeline.sources.column_file import NO_TIME
from fantwin.pipeline.sources.tables.clocks import continued, goes_back, is_date
from fantwin.pipeline.sources.tables.fan_columns import FanColumns
from fantwin.schemas.messages import Array
from fantwin.schemas.units import NS_PER_S, period_in_words

GAP_IN_MEDIAN_PERIODS = 5.0


def _counted(text: str) -> int:
    """A count of irregularities, and its words."""
    return field(default=0, metadata={"text": text})


@dataclass(frozen=True)
class Repairs:
    """Counts of irregularities in a table, in rows unless stated otherwise."""

    rows: int = 0
    without_time: int = _counted("rows dropped: their time cannot be read")
    out_of_order: int = _counted("rows out of order, sorted by time")
    repeated: int = _counted("rows with the time of another, merged: mean speed, last command")
    before_command: int = _counted("rows before the first command dropped")
    commands_held: int = _counted("cells without a command: the previous command is held")
    speeds_missing: int = _counted("cells without a speed, not filled")

    @property
    def in_words(self) -> list[str]:
        """A line for each kind that was found."""
        counts = [(getattr(self, each.name), each.metadata.get("text")) for each in fields(self)]
        return [f"{count} {text}" for count, text in counts if count and text]

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
    """notes on how it was read and what was left out, a line each"""
    labels: tuple[str, ...] = ()
    """what its file calls each fan, where it has names"""

    @property
    def has_dates(self) -> bool:
        """Whether times are since 1970."""
        return is_date(int(self.t_ns[0]))

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
        notes = [*self.remarks, *self.repairs.in_words]
        if self.gaps:
            longest = period_in_words(GAP_IN_MEDIAN_PERIODS * self.median_period_s)
            notes.append(f"{self.gaps} gaps longer than {longest}, not filled")
        if 2 * self.repairs.repeated > self.repairs.rows:
            notes.append("most times repeat: the time column is too coarse; choose another, or use --period")
        return tuple(notes)


def table_of(
    path: Path,
    chosen: FanColumns,
    values: Mapping[str, Array],
    t_ns: Array,
    rad_s_per_unit: float,
    unit: str,
    *,
    longest_part: bool = False,
) -> Table:
    """The samples of fans from columns: rows sorted by time, commands held, rows of the same time merged, and all of it
    counted. A step that changes nothing copies nothing: most tables are in order and may be large.

    values: (n,) of each column by its name; a channel without one is NaN. t_ns: (n,), NO_TIME where unknown.
    rad_s_per_unit: of the values of speed. longest_part: as for `continued`.

    Raises:
        UserError: no two rows are left, or times go back.
    """
    unknown = np.full(len(t_ns), np.nan)
    command, speed, *others = (
        np.column_stack([values[name] if name else unknown for name in names])
        for names in (chosen.command, chosen.speed, *chosen.others.values())
    )
    speed *= rad_s_per_unit
    has_time = t_ns != NO_TIME
    columns = _rows([t_ns, command, np.hstack([speed, *others])], has_time)
    clock = continued(path, columns[0], has_time, longest_part=longest_part)
    columns = _rows([clock.t_ns, *columns[1:]], clock.is_good)
    out_of_order = 0
    if goes_back(columns[0]):
        out_of_order = int(np.count_nonzero(np.maximum.accumulate(columns[0]) - columns[0]))
        order = np.argsort(columns[0], kind="stable")
        columns = [each[order] for each in columns]
    missing = np.isnan(columns[1])
    if missing.any():
        columns[1] = hold_last(columns[1])
    known = ~np.any(np.isnan(columns[1]), axis=1)
    t_ns, command, measured = _rows(columns, known)
    first = np.flatnonzero(np.diff(t_ns, prepend=t_ns[:1] - 1))
    if len(first) < 2:
        raise UserError(f"{path}: fewer than two rows with a time and a command")
    repairs = Repairs(
        rows=len(has_time),
        without_time=int(np.count_nonzero(~has_time)),
        out_of_order=out_of_order,
        repeated=len(t_ns) - len(first),
        before_command=int(np.count_nonzero(~known)),
        commands_held=int(np.count_nonzero(missing[known])),
        speeds_missing=int(np.count_nonzero(np.isnan(measured[:, : len(chosen.speed)]))),
    )
    if repairs.repeated:
        last = np.append(first[1:], len(t_ns)) - 1
        t_ns, command, measured = t_ns[first], command[last], _means(measured, first)
    of_speed, *of_others = np.split(measured, len(others) + 1, axis=1)
    auxiliary = dict(zip(chosen.others, of_others, strict=True))
    return Table(path, t_ns, command, of_speed, unit, repairs, auxiliary=auxiliary, remarks=clock.notes)


def _rows(columns: Sequence[Array], keep: Array) -> list[Array]:
    return list(columns) if keep.all() else [each[keep] for each in columns]


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
