"""Samples of fans from the fields of a log: commands at the times of the speeds."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from fantwin.pipeline.sources.logs.known_fields import Unmeasured, read_measured, stops_where_nan
from fantwin.pipeline.sources.logs.log_file import LogFile, Series
from fantwin.pipeline.sources.tables.clocks import Clock, continued
from fantwin.pipeline.sources.tables.fan_columns import FanColumns, fan_columns
from fantwin.pipeline.sources.tables.measured_table import (
    NO_COLUMNS,
    Table,
    constant_commands,
    rad_s_per,
    table_of,
    used_fans,
)
from fantwin.pipeline.sources.tables.units import SPEED_UNITS
from fantwin.schemas.messages import Array


def read_samples(
    path: Path,
    log: LogFile,
    command: Sequence[str],
    speed: Sequence[str],
    poles: int | None,
    *,
    auxiliary: Mapping[str, Sequence[str]] = NO_COLUMNS,
) -> tuple[Table, tuple[str, ...]]:
    """The samples of the fans, and notes for people.

    command, speed, auxiliary: as for `fan_columns`. poles: of the motors, for `erpm`. Values of `auxiliary` hold until
    the next one, as commands do.

    Raises:
        UserError: the fields or units cannot be used.
    """
    chosen = fan_columns(path, log.names, command, speed, auxiliary, SPEED_UNITS)
    series, unmeasured = read_measured(log, chosen.names)
    series, clocks = _continued(path, series)
    t_ns, speeds = _speeds([series[name] for name in chosen.speed])
    values = {name: _held(each, t_ns) for name, each in series.items()} | dict(zip(chosen.speed, speeds.T, strict=True))
    chosen, left_out = used_fans(path, chosen, values)
    stopped = _without_stops(chosen, series, values, t_ns)
    has_time = np.ones(len(t_ns), np.bool_)
    table = table_of(path, chosen, values, t_ns, has_time, *rad_s_per(chosen.unit or "rad/s", poles))
    assumed = f"speeds in rad/s assumed; if that is wrong, use for example {chosen.assumed}" if chosen.assumed else ""
    silent = _unmeasured_in_words([each for each in unmeasured if each.values and each.field in chosen.names])
    notes = (*log.notes, *chosen.notes, *left_out, *silent, *clocks, *stopped, *_rates(series, chosen))
    remarks = (*table.remarks, *constant_commands(chosen, table.command))
    return replace(table, assumed=assumed, remarks=remarks), notes


def _unmeasured_in_words(unmeasured: Sequence[Unmeasured]) -> list[str]:
    found: dict[str, dict[str, int]] = {}
    for each in unmeasured:
        found.setdefault(each.where, {})[each.field] = each.values
    return [
        f"{_with_others(counts)}: {sum(counts.values())} values left out, where {where}"
        for where, counts in found.items()
    ]


def _continued(path: Path, series: Mapping[str, Series]) -> tuple[dict[str, Series], list[str]]:
    """The fields with times that go on, from when all of them do to when one no longer does: a command that is read in
    part must not hold for the rest. Those of a topic share their times, which are looked at once."""
    found: dict[str, Series] = {}
    notes: list[str] = []
    t_ns, clock = np.zeros(0, np.int64), Clock(np.zeros(0, np.int64), np.zeros(0, np.bool_))
    first_ns, last_ns = -np.inf, np.inf
    for name, each in series.items():
        if not np.array_equal(each.t_ns, t_ns):
            t_ns = each.t_ns
            clock = continued(path, t_ns, np.ones(len(t_ns), np.bool_), longest_part=True)
            notes += [f"{name}: {note}" for note in clock.notes]
            good_ns = clock.t_ns[clock.is_good]
            first_ns = first_ns if clock.is_good[:1].all() else max(first_ns, good_ns[0])
            last_ns = last_ns if clock.is_good[-1:].all() else min(last_ns, good_ns[-1])
        found[name] = Series(clock.t_ns[clock.is_good], each.values[clock.is_good])
    inside = {name: (each.t_ns >= first_ns) & (each.t_ns <= last_ns) for name, each in found.items()}
    return {name: Series(each.t_ns[inside[name]], each.values[inside[name]]) for name, each in found.items()}, notes


def _without_stops(
    chosen: FanColumns, series: Mapping[str, Series], values: dict[str, Array], t_ns: Array
) -> list[str]:
    """Take away the speeds at which a command says that its motor is stopped, as it is no number; a note on that."""
    counts: dict[str, int] = {}
    for command, speed in zip(chosen.command, chosen.speed, strict=True):
        if stops_where_nan(command):
            is_stopped = np.isnan(_held(series[command], t_ns, through_nan=False)) & np.isfinite(values[command])
            values[speed] = np.where(is_stopped, np.nan, values[speed])
            counts |= {speed: int(np.count_nonzero(is_stopped))} if is_stopped.any() else {}
    why = "where their commands are NaN, as the motors were stopped"
    return [f"{_with_others(counts)}: {sum(counts.values())} values left out, {why}"] if counts else []


def _with_others(names: Collection[str]) -> str:
    return f"{next(iter(names))} and {len(names) - 1} more" if len(names) > 1 else next(iter(names))


def _rates(series: Mapping[str, Series], chosen: FanColumns) -> list[str]:
    command_hz, speed_hz = series[chosen.command[0]].rate_hz, series[chosen.speed[0]].rate_hz
    if not speed_hz or 0.9 < command_hz / speed_hz < 1.1:
        return []
    faster = ": those between two readings are not in the recording" if command_hz > speed_hz else ""
    return [
        f"commands at {command_hz:.3g} Hz, speeds at {speed_hz:.3g} Hz; each speed has the command held then{faster}"
    ]


def _speeds(series: Sequence[Series]) -> tuple[Array, Array]:
    """All times at which a speed was read, in the order of the log where they are common, and (n, fans) speeds, NaN
    where a fan has none then."""
    first = series[0].t_ns
    if all(np.array_equal(each.t_ns, first) for each in series):
        return first, np.column_stack([each.values for each in series])
    t_ns = np.unique(np.concatenate([each.t_ns for each in series]))
    speeds = np.full((len(t_ns), len(series)), np.nan)
    for fan, each in enumerate(series):
        speeds[np.searchsorted(t_ns, each.t_ns), fan] = each.values
    return t_ns, speeds


def _held(command: Series, t_ns: Array, *, through_nan: bool = True) -> Array:
    """The command at these times: the last one that is known; NaN before the first. through_nan: NaN tells nothing."""
    known = np.isfinite(command.values) | (not through_nan)
    order = np.argsort(command.t_ns[known], kind="stable")
    times, values = command.t_ns[known][order], command.values[known][order]
    at = np.searchsorted(times, t_ns, "right") - 1
    return np.where(at >= 0, values[np.maximum(at, 0)], np.nan) if len(values) else np.full(len(t_ns), np.nan)
