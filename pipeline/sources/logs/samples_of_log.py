"""Samples of fans from the fields of a log: commands at the times of the speeds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from fantwin.pipeline.sources.logs.log_file import LogFile, Series
from fantwin.pipeline.sources.tables.fan_columns import FanColumns, fan_columns
from fantwin.pipeline.sources.tables.measured_table import NO_COLUMNS, Table, rad_s_per, table_of, used_fans
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
    series = log.read(chosen.names)
    t_ns, speeds = _speeds([series[name] for name in chosen.speed])
    values = {name: _held(each, t_ns) for name, each in series.items()} | dict(zip(chosen.speed, speeds.T, strict=True))
    chosen, left_out = used_fans(path, chosen, values)
    has_time = np.ones(len(t_ns), np.bool_)
    table = table_of(path, chosen, values, t_ns, has_time, *rad_s_per(chosen.unit or "rad/s", poles))
    assumed = f"speeds in rad/s assumed; if that is wrong, use for example {chosen.assumed}" if chosen.assumed else ""
    return replace(table, assumed=assumed), (*log.notes, *chosen.notes, *left_out, *_rates(series, chosen))


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


def _held(command: Series, t_ns: Array) -> Array:
    """The command at these times: the last one that is known; NaN before the first."""
    known = np.isfinite(command.values)
    order = np.argsort(command.t_ns[known], kind="stable")
    times, values = command.t_ns[known][order], command.values[known][order]
    at = np.searchsorted(times, t_ns, "right") - 1
    return np.where(at >= 0, values[np.maximum(at, 0)], np.nan) if len(values) else np.full(len(t_ns), np.nan)
