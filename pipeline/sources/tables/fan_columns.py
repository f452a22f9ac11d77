"""Which columns of a table, or fields of a log, are of which fan: by their names, or by a pattern for all fans."""

from __future__ import annotations

import difflib
import re
import shlex
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from fantwin.pipeline.errors import UsageError, UserError

FAN_NUMBER = re.compile(r"\*|\{fan\}")
MOST_SHOWN = 8


@dataclass(frozen=True)
class FanColumns:
    """The columns of each fan.

    Attributes:
        command, speed: their names, one for each fan.
        others: what else was measured, by the name of its channel; an empty name where a fan has none.
        unit: of the speeds; empty if none was given.
        assumed: how to give a unit of the speeds, as an option of a command; empty if one was given.
        notes: what was left out, a line each.
    """

    command: tuple[str, ...]
    speed: tuple[str, ...]
    others: Mapping[str, tuple[str, ...]]
    unit: str
    assumed: str
    notes: tuple[str, ...]

    @property
    def names(self) -> list[str]:
        """All columns, each once."""
        others = (name for names in self.others.values() for name in names if name)
        return list(dict.fromkeys((*self.command, *self.speed, *others)))


def fan_columns(
    path: Path,
    names: Sequence[str],
    command: Sequence[str],
    speed: Sequence[str],
    auxiliary: Mapping[str, Sequence[str]],
    units: Collection[str],
) -> FanColumns:
    """The columns that were asked for, each by its name, or all fans by patterns.

    command: one for all fans, or one for each. speed: one for each, `NAME` or `NAME:UNIT`. Or one pattern for each of
    the two, in which `*` or `{fan}` stands for the number of a fan; a fan has both. auxiliary: what else was measured,
    by the name of its channel: one column for all fans, one for each, or a pattern. units: of speeds.

    Raises:
        UserError: there is no such column.
        UsageError: names, patterns and units do not fit together.
    """
    split = [with_unit(given, names, units) for given in speed]
    given_units = list(dict.fromkeys(unit for _, unit in split))
    if len(given_units) > 1:
        raise UsageError(f"speeds in {', '.join(unit or 'no unit' for unit in given_units)}: give all in one unit")
    speeds = [name for name, _ in split]
    patterns = [given for given in (*command, *speeds) if _is_pattern(given, names)]
    if not patterns:
        of_fans = dict(enumerate(zip(_of_each(path, names, command, len(speeds), "command"), speeds, strict=True)))
        for name in speeds:
            require(path, names, name)
        left_out: list[str] = []
    elif len(speed) != 1 or len(command) != 1:
        raise UsageError(f"{patterns[0]}: with * or {{fan}} give --command and --speed once each")
    elif not _is_pattern(speeds[0], names):
        raise UsageError(f"--speed {speeds[0]} is one column, and --command has a pattern: give a pattern for both")
    else:
        found = _matches(path, names, speeds[0])
        if _is_pattern(command[0], names):
            commands = _matches(path, names, command[0])
        else:
            require(path, names, command[0])
            commands = dict.fromkeys(found, command[0])
        of_fans = {fan: (commands[fan], found[fan]) for fan in found if fan in commands}
        left_out = [name for fan, name in (*commands.items(), *found.items()) if fan not in of_fans]
        if not of_fans:
            raise UserError(f"{path}: no fan has both {command[0]} and {speeds[0]}")
    more = f" and {len(left_out) - 3} more" if len(left_out) > 3 else ""
    note = f"left out, because only one of command and speed is there: {', '.join(left_out[:3])}{more}"
    others: dict[str, tuple[str, ...]] = {}
    for channel, given in auxiliary.items():
        if len(given) == 1 and _is_pattern(given[0], names):
            matching = _matches(path, names, given[0])
            others[channel] = tuple(matching.get(fan, "") for fan in of_fans)
        else:
            others[channel] = _of_each(path, names, given, len(of_fans), channel)
    return FanColumns(
        command=tuple(name for name, _ in of_fans.values()),
        speed=tuple(name for _, name in of_fans.values()),
        others=others,
        unit=given_units[0],
        assumed="" if given_units[0] else f"--speed {shlex.quote(f'{speeds[0]}:rpm')}",
        notes=(note,) if left_out else (),
    )


def with_unit(given: str, names: Sequence[str], units: Collection[str]) -> tuple[str, str]:
    """Name or pattern, and unit, of `NAME:UNIT`; the unit is empty if none is given.

    Raises:
        UsageError: the unit is not one of these.
    """
    name, colon, unit = (part.strip() for part in given.rpartition(":"))
    is_known = unit.lower() in units
    if given in names or not colon or (not is_known and "/" in unit):  # topics have / in their names
        return given.strip(), ""
    if not is_known:
        raise UsageError(f"{given!r}: unknown unit {unit!r}; known: {', '.join(units)}")
    return name, unit.lower()


def require(path: Path, names: Sequence[str], name: str) -> None:
    """Raise an error where not exactly one column has this name.

    Raises:
        UserError: there is none, or there are several.
    """
    if name not in names:
        raise UserError(f"{path}: no column {name!r}; {_there_are(names, name)}")
    if names.count(name) > 1:
        raise UserError(f"{path}: {names.count(name)} columns are called {name!r}; rename them in its first line")


def _is_pattern(given: str, names: Sequence[str]) -> bool:
    return bool(FAN_NUMBER.search(given)) and given not in names


def _of_each(path: Path, names: Sequence[str], given: Sequence[str], fans: int, what: str) -> tuple[str, ...]:
    """The columns that were given of something, one for each fan."""
    for name in given:
        require(path, names, name)
    if not fans or len(given) not in (1, fans):
        raise UsageError(
            f"{len(given)} {what} and {fans} speed columns: give --speed once per fan, and {what} once for all fans or "
            "once per fan"
        )
    return tuple(given) * (fans // len(given))


def _matches(path: Path, names: Sequence[str], given: str) -> dict[int, str]:
    """The columns of a pattern by the number of the fan, in its order."""
    parts = FAN_NUMBER.split(given)
    if len(parts) > 2:
        raise UsageError(f"{given}: only one * or {{fan}} stands for the number of a fan")
    pattern = re.compile(rf"{re.escape(parts[0])}(\d+){re.escape(parts[1])}")
    found = {int(match[1]): name for name in names if (match := pattern.fullmatch(name))}
    if not found:
        raise UserError(f"{path}: no column matches {given}; {_there_are(names, given)}")
    return dict(sorted(found.items()))


def _there_are(names: Sequence[str], given: str) -> str:
    close = difflib.get_close_matches(given, names, n=3, cutoff=0.5)
    if close:
        return f"did you mean {' or '.join(map(repr, close))}?"
    known = list(filter(None, names))
    more = f" and {len(known) - MOST_SHOWN} more; --list shows those of a log" if len(known) > MOST_SHOWN else ""
    return f"it has {', '.join(known[:MOST_SHOWN])}{more}"
