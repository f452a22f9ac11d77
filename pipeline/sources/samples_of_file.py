"""Samples of fans from the columns of a file: which columns are fans, in which units, and commands at the times of the
speeds. What is left out is said."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from fantwin.pipeline.errors import UsageError, UserError
from fantwin.pipeline.sources.column_file import NO_TIME, Column, ColumnFile, listed
from fantwin.pipeline.sources.measured_where import LeftOut, read_measured, stops_where_nan
from fantwin.pipeline.sources.tables.clocks import Clock, continued
from fantwin.pipeline.sources.tables.fan_columns import FanColumns, fan_columns, used_fans
from fantwin.pipeline.sources.tables.measured_table import Table, table_of
from fantwin.pipeline.sources.tables.profiles import Profile, profile_of
from fantwin.pipeline.sources.tables.units import ELECTRICAL, SPEED_UNITS, in_unit_of, rad_s_per, unit_in_name
from fantwin.pipeline.sources.wanted import Wanted
from fantwin.schemas.channels import BY_NAME
from fantwin.schemas.messages import Array
from fantwin.schemas.units import RAD_S_PER_UNIT

_MOST_NAMED = 8
_NO_READING = (-1, 65535, 4294967295)
"""speeds that programs and chips give where they have none"""
_NAMES_OF_SPEEDS = {"a", "c", "v", "s", "h", "min"}
"""units that are letters or words in a name, such as `speed_a` and `rpm_min`"""
_FEWEST_ROWS = 8
"""rows of a table whose newest is the first"""
_FAR_BEYOND = 3.0
"""times most other speeds, above which one of these is no reading"""
_BEYOND_RPM = 100_000.0
"""speed beyond that of any fan"""


def chosen_fans(path: Path, file: ColumnFile, wanted: Wanted, profile: Profile | None) -> FanColumns:
    """The columns of the fans: those that the user names, else those of the program that wrote the file.

    Raises:
        UserError: there are none.
    """
    where = str(path) if file.is_rows else f"{path}: {file.title}"
    if wanted.command and wanted.speed:
        return fan_columns(where, file.names, wanted.command, wanted.speed, wanted.channels)
    known = profile.fans_in(file) if profile else FanColumns((), ())
    if wanted.command or wanted.speed or not known.speed or profile is None:
        speeds = profile.speeds_in(file) if profile else ()
        why = f"{where}: no command of {listed(speeds)}; " if speeds and not known.speed else ""
        raise UsageError(f"{why}an import needs --command and --speed; --preview shows the columns")
    named = fan_columns(where, file.names, known.command, known.speed, wanted.channels)
    fans = zip(known.labels, known.command, known.speed, strict=True)
    said = [f"{label or speed}: command {command!r}, speed {speed!r}" for label, command, speed in fans]
    notes = [f"columns of {profile.title}: {listed(said, _MOST_NAMED)}"]
    if unused := [name for name in profile.speeds_in(file) if name not in known.speed]:
        notes.append(f"speeds without a command of their own, or second ones, left out: {listed(unused)}")
    return replace(known, others={**known.others, **named.others}, notes=tuple(notes))


def samples_of(path: Path, file: ColumnFile, wanted: Wanted) -> Table:
    """The samples of the fans of a file. Values of channels hold until the next one, as commands do, where a file has
    them at other times than the speeds.

    Raises:
        UserError: the columns or units cannot be used.
    """
    profile = profile_of(file)
    chosen = chosen_fans(path, file, wanted, profile)
    columns, left_out = read_measured(file, chosen.names)
    for name, column in columns.items():
        if column.problem:
            raise column.problem
        if not chosen.is_found and not np.any(np.isfinite(column.values)):
            raise UserError(f"{path}: column {name!r} has no numbers{column.note and f', but {column.note}'}")
    columns, clocks = _continued(path, columns)
    t_ns, values = _at_times_of_speeds(columns, chosen)
    if _is_newest_first(t_ns):
        t_ns, values = t_ns[::-1], {name: each[::-1] for name, each in values.items()}
        clocks = [*clocks, "the newest row is the first: read from the last"]
    left_out += _error_codes(chosen, values)
    chosen = used_fans(path, chosen, values)
    left_out += _stops(chosen, columns, values, t_ns)
    unit, of_units = speed_unit(chosen, columns, profile)
    for channel, names in chosen.others.items():
        for name in dict.fromkeys(filter(None, names)):
            of_file = _unit(name, columns) or (profile.units.get(name, "") if profile else "")
            values[name], note = in_unit_of(channel, name, values[name], of_file)
            left_out.append(_beyond(channel, name, values))
            taken = f"{channel} from {name!r}: {_span(values[name])} {BY_NAME[channel].unit}"
            of_units += filter(None, (note, taken))
    rad_s, shown = rad_s_per(unit or "rad/s", wanted.poles)
    if wanted.poles and not unit.startswith(ELECTRICAL):
        of_units.append(f"--poles is for speeds in erpm, and has no effect on {shown}")
    left_out += _impossible(chosen, values, rad_s)
    table = table_of(path, chosen, values, t_ns, rad_s, shown, longest_part=not file.is_rows)
    twice = [speed for command, speed in zip(chosen.command, chosen.speed, strict=True) if command == speed]
    if wanted.has_command and twice:
        raise UsageError(f"{path}: {twice[0]!r} is named as command and as speed: a fan needs a column of each")
    example = f"--speed {shlex.quote(f'{(*wanted.speed, *chosen.speed)[0]}:rpm')}"
    remarks = (
        *file.notes,
        *chosen.notes,
        *(f"{name!r}: {columns[name].note}" for name in chosen.names if columns[name].note),
        *_in_words([each for each in left_out if each.values and each.name in chosen.names]),
        *clocks,
        *_rates(columns, chosen),
        *of_units,
        *table.remarks,
        *_constant_commands(chosen, table.command),
    )
    assumed = _assumed(file.assumed, None if unit else ("speeds in rad/s", example))
    return replace(table, assumed=assumed, remarks=remarks, labels=chosen.labels)


def speed_unit(chosen: FanColumns, columns: Mapping[str, Column], profile: Profile | None) -> tuple[str, list[str]]:
    """The unit of the speeds: the one that the user gives, else that of the file or its names, else the usual one of
    the program; empty: none is known. And notes on it.

    Raises:
        UsageError: the file has speeds in several.
    """
    in_file = {name: "" if (unit := _unit(name, columns)) in _NAMES_OF_SPEEDS else unit for name in chosen.speed}
    units = [chosen.unit] if chosen.unit else list(dict.fromkeys(in_file.values()))
    if len(units) > 1 or units[0] not in ("", *SPEED_UNITS):
        raise UsageError(
            f"speeds in {', '.join(unit or 'no unit' for unit in units)}, as the file says: give one unit of a speed, "
            f"as in --speed {shlex.quote(f'{chosen.speed[0]}:rpm')}, or import them apart"
        )
    unit, notes = profile.unit_of(chosen.speed, units[0]) if profile else (units[0], [])
    others = [name for name, of_file in in_file.items() if of_file and of_file != unit.removesuffix("/100")]
    if others:
        notes.append(f"{listed(others)}: in {in_file[others[0]]} by the file, and read in {unit}, as you say")
    return unit, notes


def _unit(name: str, columns: Mapping[str, Column]) -> str:
    return columns[name].unit or unit_in_name(name)


def _assumed(*found: tuple[str, str] | None) -> str:
    """Line on the units that were assumed, each with the option that says otherwise."""
    known = list(filter(None, found))
    if not known:
        return ""
    assumed, options = (" and ".join(words) for words in zip(*known, strict=True))
    return f"no unit given, {assumed} assumed; if that is wrong, use for example {options}"


def _in_words(left_out: Sequence[LeftOut]) -> list[str]:
    """A line each reason why values are left out."""
    whys = dict.fromkeys(each.why for each in left_out)
    of_why = {why: {each.name: each.values for each in left_out if each.why == why} for why in whys}
    return [f"{listed(list(of), 1)}: {sum(of.values())} values left out, {why}" for why, of in of_why.items()]


def _at_times_of_speeds(columns: Mapping[str, Column], chosen: FanColumns) -> tuple[Array, dict[str, Array]]:
    """All times at which a speed was read, in the order of the file where they are common, and all values at them:
    commands and channels are held, a speed is NaN where its fan has none then."""
    speeds = [columns[name] for name in chosen.speed]
    t_ns = speeds[0].t_ns
    if not all(each.has_times(t_ns) for each in speeds):
        t_ns = np.unique(np.concatenate([each.t_ns for each in speeds]))
    values = {name: each.values if each.has_times(t_ns) else _held(each, t_ns) for name, each in columns.items()}
    for name, each in zip(chosen.speed, speeds, strict=True):
        if not each.has_times(t_ns):
            values[name] = np.full(len(t_ns), np.nan)
            values[name][np.searchsorted(t_ns, each.t_ns)] = each.values
    return t_ns, values


def _is_newest_first(t_ns: Array) -> bool:
    """Whether times go back from row to row, as in exports of pages that show the newest value on top."""
    known = t_ns[t_ns != NO_TIME] if len(t_ns) >= _FEWEST_ROWS and t_ns[-1] < t_ns[0] else t_ns[:1]
    return len(known) >= _FEWEST_ROWS and bool(np.all(known[1:] <= known[:-1]))


def _continued(path: Path, columns: Mapping[str, Column]) -> tuple[Mapping[str, Column], list[str]]:
    """The columns with times that go on, from when all of them do to when one no longer does: a command that is read in
    part must not hold for the rest. Columns that share their times are rows, and are left as they are."""
    clocks: list[tuple[Column, Clock]] = []
    found: dict[str, Column] = {}
    notes: list[str] = []
    first, *others = columns.values()
    if all(each.has_times(first.t_ns) for each in others):
        return columns, notes
    for name, each in columns.items():
        clock = next((of for other, of in clocks if each.has_times(other.t_ns)), None)
        has_time = each.t_ns != NO_TIME
        if clock is None:
            clock = continued(path, each.t_ns[has_time], has_time, longest_part=True)
            clocks.append((each, clock))
            notes += [f"{name}: {note}" for note in clock.notes]
        found[name] = replace(each, t_ns=clock.t_ns[clock.is_good], values=each.values[has_time][clock.is_good])
    cut = [clock for _, clock in clocks if len(clock.t_ns)]
    begin_ns = max((of.t_ns[of.is_good][0] for of in cut if not of.is_good[0]), default=-np.inf)
    end_ns = min((of.t_ns[of.is_good][-1] for of in cut if not of.is_good[-1]), default=np.inf)
    for name, each in found.items():
        inside = (each.t_ns >= begin_ns) & (each.t_ns <= end_ns)
        found[name] = replace(each, t_ns=each.t_ns[inside], values=each.values[inside])
    return found, notes


def _stops(
    chosen: FanColumns, columns: Mapping[str, Column], values: dict[str, Array], t_ns: Array
) -> Iterator[LeftOut]:
    """Take away the speeds at which a command says that its motor is stopped, as it is no number."""
    for command, speed in zip(chosen.command, chosen.speed, strict=True):
        if stops_where_nan(command):
            values[command] = _held(columns[command], t_ns)
            is_stopped = np.isnan(_held(columns[command], t_ns, through_nan=False)) & np.isfinite(values[command])
            yield _without(values, speed, is_stopped, "where their commands are NaN, as the motors were stopped")


def _error_codes(chosen: FanColumns, values: dict[str, Array]) -> Iterator[LeftOut]:
    """Take away speeds that are no readings: an error code beyond most others."""
    for name in dict.fromkeys(chosen.speed):
        for code in _NO_READING:
            is_code = values[name] == code
            others = values[name][np.isfinite(values[name]) & ~is_code]
            if not len(others) or code < 0 <= others.min() or code > _FAR_BEYOND * np.quantile(others, 0.75):
                yield _without(values, name, is_code, f"an error code, {code}")


def _beyond(channel: str, name: str, values: dict[str, Array]) -> LeftOut:
    """Take away the values of a channel that cannot be true."""
    of = BY_NAME[channel]
    is_beyond = (values[name] < of.lowest) | (values[name] > of.highest)
    return _without(values, name, is_beyond, f"beyond {of.lowest:g} to {of.highest:g} {of.unit}: what is its unit?")


def _impossible(chosen: FanColumns, values: dict[str, Array], rad_s: float) -> Iterator[LeftOut]:
    """Take away speeds beyond any fan, where most are not. rad_s: of one unit of them."""
    for name in dict.fromkeys(chosen.speed):
        rpm = values[name] * rad_s / RAD_S_PER_UNIT["rpm"]
        beyond = np.abs(rpm) > _BEYOND_RPM
        if 2 * np.count_nonzero(beyond) < np.count_nonzero(rpm > 0):
            yield _without(values, name, beyond, f"up to {np.nanmax(rpm):,.0f} rpm")


def _without(values: dict[str, Array], name: str, rows: Array, why: str) -> LeftOut:
    """Take away some values of a column."""
    if rows.any():
        values[name] = np.where(rows, np.nan, values[name])
    return LeftOut(name, int(np.count_nonzero(rows)), why)


def _span(values: Array) -> str:
    known = values[np.isfinite(values)]
    return f"{known.min():.4g} to {known.max():.4g}" if len(known) else "no values in"


def _rates(columns: Mapping[str, Column], chosen: FanColumns) -> list[str]:
    command, speed = columns[chosen.command[0]], columns[chosen.speed[0]]
    command_hz, speed_hz = command.rate_hz, speed.rate_hz
    if command.t_ns is speed.t_ns or not speed_hz or 0.9 < command_hz / speed_hz < 1.1:
        return []
    faster = ": those between two readings are not in the recording" if command_hz > speed_hz else ""
    return [
        f"commands at {command_hz:.3g} Hz, speeds at {speed_hz:.3g} Hz; each speed has the command held then{faster}"
    ]


def _held(column: Column, t_ns: Array, *, through_nan: bool = True) -> Array:
    """The value at these times: the last one that is known; NaN before the first. through_nan: NaN tells nothing."""
    known = np.isfinite(column.values) | (not through_nan)
    order = np.argsort(column.t_ns[known], kind="stable")
    times, values = column.t_ns[known][order], column.values[known][order]
    at = np.searchsorted(times, t_ns, "right") - 1
    return np.where(at >= 0, values[np.maximum(at, 0)], np.nan) if len(values) else np.full(len(t_ns), np.nan)


def _constant_commands(chosen: FanColumns, command: Array) -> list[str]:
    """A note on each command (n, fans) that never changes, from which no twin can be made."""
    never = dict.fromkeys(
        (name, float(command[0, fan]))
        for fan, name in enumerate(chosen.command)
        if not np.any(np.diff(command[:, fan]))
    )
    return [f"{name} is {value:g} throughout: a twin needs steps of the command" for name, value in never]
