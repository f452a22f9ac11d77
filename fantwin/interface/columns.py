"""Columns of a table: the time, and the command and the speed of each fan."""

from __future__ import annotations

import difflib
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

from fantwin.pipeline.errors import FantwinError
from fantwin.pipeline.sources.tables.fan_columns import with_unit
from fantwin.pipeline.sources.tables.units import NS_PER_UNIT, RAD_S_PER_TABLE_UNIT
from fantwin.schemas.channels import CHANNELS

Fan: TypeAlias = int | str
"""number or name of a fan"""
OfFans: TypeAlias = str | Sequence[str] | Mapping[Fan, str]
"""one column, a pattern with `*` for the fan, one column for each fan, or that of each fan by its number or name"""
SUFFIX_OF_UNIT = {unit: re.sub(r"\W", "_", unit) for unit in RAD_S_PER_TABLE_UNIT}
_UNIT_AT_END = re.compile(rf"_({'|'.join(SUFFIX_OF_UNIT.values())})$")
_TIME_UNIT_AT_END = re.compile(rf"_({'|'.join(NS_PER_UNIT)})$")
_TIMES = ("time", "timestamp", "t", "time_s", "t_s", "time_ms", "t_ms", "time_us", "t_us", "time_ns", "t_ns")
_OF_ALL: Fan = 0
_SHOWN = 12


@dataclass(frozen=True)
class Columns:
    """Names of the columns of a table; what is left empty is found by the usual names.

    A table is *long*, with a row for each sample of a fan, or *wide*, with a row for the samples of all fans.

    Attributes:
        time: numbers or dates, `NAME` or `NAME:UNIT` with s (default), ms, us or ns. Usual: `time`, `timestamp`, `t`,
            also with a unit at the end, as in `t_ns`; else the dates of the index.
        fan: of a long table: the number or the name of the fan. Usual: `fan`.
        command: usual: `command`; of a wide table also `command_FAN`.
        speed: with its unit: `NAME:UNIT` or a name that ends in it, as in `speed_rpm`. Units: rpm, rad/s, hz
            (revolutions a second), deg/s. Usual: `speed_UNIT`; of a wide table `speed_FAN_UNIT`.

    Columns `supply_voltage_v`, `current_a` and `temperature_c`, of a wide table also with `_FAN`, are always read.

        >>> Columns(time="ms:ms", command="pwm*", speed="tacho*:rpm")
        Columns(time='ms:ms', fan='', command='pwm*', speed='tacho*:rpm')
    """

    time: str = ""
    fan: str = ""
    command: OfFans = ""
    speed: OfFans = ""


@dataclass(frozen=True)
class FoundColumns:
    """Names of the columns that a table has.

    Attributes:
        time: and how many ns a number in it is.
        fan: empty: the table is wide.
        command, speed: by fan; one, of fan 0, in a long table. Without a speed, none.
        unit: of the speeds; empty without one.
        others: by the name of their channel, and then by fan.
    """

    time: str
    ns_per_unit: int
    fan: str
    command: Mapping[Fan, str]
    speed: Mapping[Fan, str]
    unit: str
    others: Mapping[str, Mapping[Fan, str]]

    @property
    def fans(self) -> list[Fan]:
        """The fans of a wide table, in order."""
        return list(self.speed or self.command)


def find_columns(names: Sequence[str], wanted: Columns, *, needs_speed: bool) -> FoundColumns:
    """The columns of a table with these names.

    Raises:
        FantwinError: one is missing, or its unit is.
    """
    time, ns_per_unit = _time(names, wanted.time)
    fan = _required(names, wanted.fan, "fan") if wanted.fan else "fan" if "fan" in names else ""
    speed, unit = _speed(names, wanted.speed, is_long=bool(fan))
    if needs_speed and not speed:
        raise FantwinError(
            f"the table has no column of the speed, such as speed_rpm; {_it_has(names)}: name it, with its unit: "
            'fantwin.Columns(speed="NAME:rpm")'
        )
    command = _of_fans(names, wanted.command, "command", f"command{'' if fan else '_*'}", speed)
    if not command:
        raise FantwinError(
            f'the table has no column `command`; {_it_has(names)}: name it: fantwin.Columns(command="NAME")'
        )
    if fan and (len(command) > 1 or len(speed) > 1):
        raise FantwinError(
            f"column {fan!r} says of which fan a row is, so name one column of the speed, and one command"
        )
    for each in speed:
        if each not in command:
            raise FantwinError(f"fan {each} has a speed and no command: name a column for each fan, or one for all")
    found = {each.name: _of_fans(names, "", each.name, "" if fan else f"{each.name}_*", speed) for each in CHANNELS}
    others = {
        name: {each: of.get(each, "") for each in speed}
        for name, of in found.items()
        if not of.keys().isdisjoint(speed)
    }
    return FoundColumns(time, ns_per_unit, fan, command, speed, unit, others)


def _time(names: Sequence[str], wanted: str) -> tuple[str, int]:
    given, unit = with_unit(wanted, names, NS_PER_UNIT)
    name = _required(names, given, "time") if given else next((each for each in _TIMES if each in names), "")
    if not name:
        raise FantwinError(
            f"the table has no column of the time, such as `time` in s; {_it_has(names)}: name it: "
            'fantwin.Columns(time="NAME:ms")'
        )
    at_end = _TIME_UNIT_AT_END.search(name)
    return name, NS_PER_UNIT[unit or (at_end[1] if at_end else "s")]


def _speed(names: Sequence[str], wanted: OfFans, *, is_long: bool) -> tuple[dict[Fan, str], str]:
    """Columns of the speed by fan, and their unit."""
    units: set[str] = set()
    if wanted:
        given = {fan: with_unit(text, names, RAD_S_PER_TABLE_UNIT) for fan, text in _by_fan(wanted).items()}
        columns = _matching(names, {fan: name for fan, (name, _) in given.items()}, "speed")
        units = {unit for _, unit in given.values() if unit}
    else:
        pattern = re.compile(rf"speed(?:_(?P<fan>\w+?))??{_UNIT_AT_END.pattern}")
        matches = {name: match["fan"] for name in names if (match := pattern.fullmatch(name))}
        single = next((name for name in ("speed", *matches) if name in names and not matches.get(name)), None)
        columns = {_OF_ALL: single} if single else {_label(fan): name for name, fan in matches.items() if not is_long}
    units = units or {_unit_in(name) for name in columns.values()}
    if len(units) > 1:
        raise FantwinError(f"speeds in {' and '.join(sorted(units))}: convert them to one unit")
    return columns, next(iter(units), "")


def _unit_in(name: str) -> str:
    """The unit that the name of a column of speeds ends in."""
    at_end = _UNIT_AT_END.search(name)
    if at_end is None:
        raise FantwinError(
            f'in which unit is the speed {name!r}? Say it: fantwin.Columns(speed="{name}:rpm"); known: '
            f"{', '.join(SUFFIX_OF_UNIT)}"
        )
    return next(unit for unit, suffix in SUFFIX_OF_UNIT.items() if suffix == at_end[1])


def _of_fans(names: Sequence[str], wanted: OfFans, usual: str, pattern: str, fans: Collection[Fan]) -> dict[Fan, str]:
    """Columns by fan: what was wanted, else those of the usual name or pattern; one for all fans counts for each."""
    if wanted:
        found = _matching(names, _by_fan(wanted), usual)
    else:
        found = {_OF_ALL: usual} if usual in names else _matched(names, pattern) if "*" in pattern else {}
    if len(found) == 1 and (wanted == next(iter(found.values())) or usual in found.values()):
        return dict.fromkeys(fans or (_OF_ALL,), *found.values())
    return found


def _by_fan(wanted: OfFans) -> dict[Fan, str]:
    if isinstance(wanted, str):
        return {_OF_ALL: wanted}
    return dict(wanted) if isinstance(wanted, Mapping) else dict(enumerate(wanted))


def _matching(names: Sequence[str], wanted: Mapping[Fan, str], what: str) -> dict[Fan, str]:
    """Columns that are there; a pattern stands for all that match it."""
    first = next(iter(wanted.values()))
    if len(wanted) == 1 and first not in names and "*" in first:
        if not (found := _matched(names, first)):
            raise FantwinError(f"no column matches {first!r}, the {what}; {_it_has(names)}")
        return found
    return {fan: _required(names, name, what) for fan, name in wanted.items()}


def _matched(names: Sequence[str], pattern: str) -> dict[Fan, str]:
    before, _, after = pattern.partition("*")
    regex = re.compile(rf"{re.escape(before)}(\w+){re.escape(after)}")
    return {_label(match[1]): name for name in names if (match := regex.fullmatch(name))}


def _label(text: str) -> Fan:
    return int(text) if text.isdecimal() else text


def _required(names: Sequence[str], name: str, what: str) -> str:
    if name in names:
        return name
    close = difflib.get_close_matches(name, names, n=1)
    raise FantwinError(f"no column {name!r}, the {what}; {f'did you mean {close[0]!r}?' if close else _it_has(names)}")


def _it_has(names: Sequence[str]) -> str:
    return f"it has {', '.join(names[:_SHOWN]) or 'no columns'}{', ...' if len(names) > _SHOWN else ''}"
