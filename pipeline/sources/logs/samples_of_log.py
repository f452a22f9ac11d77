"""Samples of fans from the fields of a log: which field is of which fan, and commands at the times of the speeds."""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from fantwin.pipeline.errors import UsageError
from fantwin.pipeline.sources.logs.log_file import LogError, LogFile, Series
from fantwin.pipeline.sources.tables.measured_table import RAD_S_PER_TABLE_UNIT, Table, clean_samples
from fantwin.schemas.messages import Array

ELECTRICAL = "erpm"
UNITS = (*RAD_S_PER_TABLE_UNIT, ELECTRICAL)
FAN_NUMBER = re.compile(r"\*|\{fan\}")
MOST_SHOWN = 8


@dataclass(frozen=True)
class FanFields:
    """The fields of each fan, and what was decided about them, one line each. numbers: of the fans in the log."""

    command: tuple[str, ...]
    speed: tuple[str, ...]
    numbers: tuple[int, ...]
    notes: tuple[str, ...] = ()


def fan_fields(path: Path, names: Sequence[str], command: Sequence[str], speed: Sequence[str]) -> FanFields:
    """The fields that were asked for, each by its name, or all fans by patterns.

    command, speed: names; or one pattern each, in which `*` or `{fan}` stands for the number of a fan. A fan has both.

    Raises:
        LogError: there is no such field.
        UsageError: names and patterns do not fit together.
    """
    patterns = [given for given in (*command, *speed) if FAN_NUMBER.search(given)]
    if not patterns:
        for given in (*command, *speed):
            _require(path, names, given)
        if len(command) not in (1, len(speed)):
            raise UsageError(
                f"{len(command)} command and {len(speed)} speed fields: give --speed once per fan, and --command once "
                "for all fans or once per fan"
            )
        return FanFields(tuple(command) * (len(speed) // len(command)), tuple(speed), tuple(range(len(speed))))
    if len(speed) != 1 or len(command) != 1:
        raise UsageError(f"{patterns[0]}: with * or {{fan}} give --command and --speed once each")
    speeds = _matches(path, names, speed[0])
    commands = _matches(path, names, command[0])
    if not FAN_NUMBER.search(command[0]):
        return FanFields((command[0],) * len(speeds), tuple(speeds.values()), tuple(speeds))
    if not FAN_NUMBER.search(speed[0]):
        raise UsageError(f"--speed {speed[0]} is one field, and --command has a pattern: give a pattern for both")
    fans = [fan for fan in speeds if fan in commands]
    if not fans:
        raise LogError(f"{path}: no fan has both {command[0]} and {speed[0]}")
    left_out = [*(commands[fan] for fan in commands if fan not in speeds)]
    left_out += [*(speeds[fan] for fan in speeds if fan not in commands)]
    more = f" and {len(left_out) - 3} more" if len(left_out) > 3 else ""
    notes = (
        (f"left out, because only one of command and speed is there: {', '.join(left_out[:3])}{more}",)
        if left_out
        else ()
    )
    return FanFields(tuple(commands[fan] for fan in fans), tuple(speeds[fan] for fan in fans), tuple(fans), notes)


def read_samples(
    path: Path,
    log: LogFile,
    command: Sequence[str],
    speed: Sequence[str],
    poles: int | None,
    *,
    auxiliary: Mapping[str, Sequence[str]] | None = None,
) -> tuple[Table, tuple[str, ...]]:
    """The samples of the fans, and notes for people.

    command, speed: as for `fan_fields`, a speed with its unit as `NAME:UNIT`. poles: of the motors, for `erpm`.
    auxiliary: fields of what else was measured, by the name of its column: one for all fans, one per fan, or a pattern.
    Their values hold until the next one, as commands do.

    Raises:
        UserError: the fields or units cannot be used.
    """
    split = [_with_unit(given, log.names) for given in speed]
    units = {unit for _, unit in split}
    if len(units) != 1:
        raise UsageError(f"speeds in {', '.join(sorted(unit or 'no unit' for unit in units))}: give all in one unit")
    (unit,) = units
    chosen = fan_fields(path, log.names, command, [name for name, _ in split])
    others = {name: _of_fans(path, log.names, given, chosen) for name, given in (auxiliary or {}).items()}
    measured = [name for names in others.values() for name in names if name]
    series = log.read(list(dict.fromkeys((*chosen.command, *chosen.speed, *measured))))
    factor, shown = _rad_s_per(unit or "rad/s", poles)
    t_ns, speeds = _speeds([series[name] for name in chosen.speed])
    commands = np.column_stack([_held(series[name], t_ns) for name in chosen.command])
    unknown = np.full(len(t_ns), np.nan)
    held = [_held(series[name], t_ns) if name else unknown for names in others.values() for name in names]
    values = np.column_stack([speeds * factor, *held])
    table = clean_samples(path, t_ns, np.ones(len(t_ns), np.bool_), commands, values, shown)
    of_speed, *of_others = np.split(table.speed_rad_s, len(others) + 1, axis=1)
    table = replace(table, speed_rad_s=of_speed, auxiliary=dict(zip(others, of_others, strict=True)))
    assumed = "" if unit else f"speeds in rad/s assumed; if that is wrong, use for example --speed {split[0][0]}:rpm"
    notes = [*log.notes, *chosen.notes, *([assumed] if assumed else []), *_rates(series, chosen)]
    return table, tuple(notes)


def _of_fans(path: Path, names: Sequence[str], given: Sequence[str], chosen: FanFields) -> list[str]:
    """The field of each fan; empty where it has none."""
    if len(given) == 1 and FAN_NUMBER.search(given[0]):
        found = _matches(path, names, given[0])
        return [found.get(number, "") for number in chosen.numbers]
    for each in given:
        _require(path, names, each)
    fans = len(chosen.speed)
    if len(given) not in (1, fans):
        raise UsageError(f"{given[0]} and {len(given) - 1} more for {fans} fans: give one for all fans, or one per fan")
    return list(given) * (fans // len(given))


def _rates(series: Mapping[str, Series], chosen: FanFields) -> list[str]:
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


def _rad_s_per(unit: str, poles: int | None) -> tuple[float, str]:
    """rad/s of one unit, and the unit that people are shown."""
    if unit != ELECTRICAL:
        return RAD_S_PER_TABLE_UNIT[unit], unit
    if poles is None:
        raise UsageError(
            "speeds in erpm are electrical revolutions: give the magnetic poles of the motor, for example --poles 14"
        )
    if poles < 2 or poles % 2:
        raise UsageError(f"--poles {poles}: magnetic poles come in pairs, for example 14")
    return 2.0 * math.pi / 60.0 / (poles / 2), "rpm"


def _with_unit(given: str, names: Sequence[str]) -> tuple[str, str]:
    """Name or pattern, and unit; empty if none is given."""
    name, colon, unit = given.rpartition(":")
    if given in names or not colon or "/" in unit.replace("rad/s", "").replace("deg/s", ""):
        return given, ""
    if unit.lower() not in UNITS:
        raise UsageError(f"{given!r}: unknown unit {unit!r}; known: {', '.join(UNITS)}")
    return name, unit.lower()


def _matches(path: Path, names: Sequence[str], given: str) -> dict[int, str]:
    """The fields of a pattern by the number of the fan; of a name that field."""
    parts = FAN_NUMBER.split(given)
    if len(parts) == 1:
        _require(path, names, given)
        return {0: given}
    if len(parts) > 2:
        raise UsageError(f"{given}: only one * or {{fan}} stands for the number of a fan")
    pattern = re.compile(rf"{re.escape(parts[0])}(\d+){re.escape(parts[1])}")
    found = {int(match[1]): name for name in names if (match := pattern.fullmatch(name))}
    if not found:
        raise LogError(f"{path}: no field matches {given}; --list shows them all{_like(names, given)}")
    return dict(sorted(found.items()))


def _require(path: Path, names: Sequence[str], given: str) -> None:
    if given not in names:
        raise LogError(f"{path}: no field {given!r}; --list shows them all{_like(names, given)}")


def _like(names: Sequence[str], given: str) -> str:
    close = difflib.get_close_matches(given, names, n=3, cutoff=0.5)
    return f"; did you mean {' or '.join(map(repr, close))}?" if close else ""
