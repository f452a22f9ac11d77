"""Which columns of a table, or fields of a log, are of which fan: by their names, or by a pattern for all fans."""

from __future__ import annotations

import difflib
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from fantwin.pipeline.errors import UsageError, UserError
from fantwin.pipeline.sources.column_file import listed
from fantwin.pipeline.sources.tables.units import SPEED_UNITS
from fantwin.schemas.messages import Array

FAN_NUMBER = re.compile(r"\*|\{fan\}")
MOST_SHOWN = 8


@dataclass(frozen=True)
class FanColumns:
    """The columns of each fan.

    Attributes:
        command, speed: their names, one for each fan.
        others: what else was measured, by the name of its channel; an empty name where a fan has none.
        unit: of the speeds; empty if none was given.
        notes: what was left out, a line each.
        is_found: whether the fans are those that a pattern or a program has, and none was named.
        labels: what people call each fan; empty where its number says it.
    """

    command: tuple[str, ...]
    speed: tuple[str, ...]
    others: Mapping[str, tuple[str, ...]] = field(default_factory=dict[str, tuple[str, ...]])
    unit: str = ""
    notes: tuple[str, ...] = ()
    is_found: bool = False
    labels: tuple[str, ...] = ()

    @property
    def names(self) -> list[str]:
        """All columns, each once."""
        others = (name for names in self.others.values() for name in names if name)
        return list(dict.fromkeys((*self.command, *self.speed, *others)))


def fan_columns(
    where: str,
    names: Sequence[str],
    command: Sequence[str],
    speed: Sequence[str],
    auxiliary: Mapping[str, Sequence[str]],
) -> FanColumns:
    """The columns of the fans among those of a file. where: the file, for people.

    command: one column for all fans, one for each, or a pattern for all of them, such as `output[*]` or
    `output[{fan}]`. speed: likewise, each with or without `:UNIT`, all in one unit. auxiliary: what else was measured,
    by the name of its channel: one column for all fans, one for each, or a pattern.

    Raises:
        UserError: there is no such column.
        UsageError: names, patterns and units do not fit together.
    """
    split = [with_unit(given, names, SPEED_UNITS) for given in speed]
    units = list(dict.fromkeys(unit for _, unit in split))
    if len(units) > 1:
        raise UsageError(f"speeds in {', '.join(unit or 'no unit' for unit in units)}: give all in one unit")
    speeds = [name for name, _ in split]
    if _is_pattern(command, names) and not _is_pattern(speeds, names):
        raise UsageError(f"--command {command[0]} is a pattern for all fans: give one as --speed, too")
    of_speed = _by_fan(where, names, speeds)
    of_command = _for_fans(where, names, command, of_speed, "command")
    fans = [fan for fan in of_speed if fan in of_command]
    if not fans:
        raise UserError(f"{where}: no fan has both {command[0]} and {speeds[0]}")
    left_out = [name for fan, name in (*of_command.items(), *of_speed.items()) if fan not in fans]
    others = {channel: _for_fans(where, names, given, fans, channel) for channel, given in auxiliary.items()}
    return FanColumns(
        command=tuple(of_command[fan] for fan in fans),
        speed=tuple(of_speed[fan] for fan in fans),
        others={channel: tuple(found.get(fan, "") for fan in fans) for channel, found in others.items()},
        unit=units[0],
        notes=(f"left out, because only one of command and speed is there: {listed(left_out)}",) if left_out else (),
        is_found=_is_pattern(speeds, names),
    )


def used_fans(path: Path, chosen: FanColumns, values: Mapping[str, Array]) -> FanColumns:
    """The fans that ever turned and had a command, of those that nobody named, with a note on the others: boards and
    flight controllers log slots that nothing is connected to.

    Raises:
        UserError: none is left.
    """
    turned = [bool(np.any(np.nan_to_num(values[name]) != 0)) for name in chosen.speed]
    commanded = [bool(np.any(np.isfinite(values[name]))) for name in chosen.command]
    used = [k for k, both in enumerate(zip(turned, commanded, strict=True)) if all(both)]
    if not chosen.is_found or len(used) == len(turned):
        return chosen
    unused = [name for k, name in enumerate(chosen.speed) if k not in used]
    if not used:
        raise UserError(f"{path}: no fan of {listed(unused)} ever turns")
    return replace(
        chosen,
        command=tuple(chosen.command[k] for k in used),
        speed=tuple(chosen.speed[k] for k in used),
        others={channel: tuple(names[k] for k in used) for channel, names in chosen.others.items()},
        notes=(*chosen.notes, f"left out, because the speed is always 0 or missing: {listed(unused)}"),
        labels=tuple(chosen.labels[k] for k in used if chosen.labels),
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


def require(where: str, names: Sequence[str], name: str) -> None:
    """Raise UserError where no column has this name."""
    if name not in names:
        raise UserError(f"{where}: no column {name!r}; {_there_are(names, name)}")


def _is_pattern(given: Sequence[str], names: Sequence[str]) -> bool:
    return len(given) == 1 and given[0] not in names and bool(FAN_NUMBER.search(given[0]))


def _for_fans(
    where: str, names: Sequence[str], given: Sequence[str], fans: Collection[int], what: str
) -> dict[int, str]:
    """The columns of something by fan: one for all fans, one for each, or those of a pattern."""
    if _is_pattern(given, names):
        return _by_fan(where, names, given)
    if len(given) not in (1, len(fans)):
        raise UsageError(
            f"{len(given)} {what} and {len(fans)} speed columns: give --speed once per fan, and {what} once for all "
            "fans or once per fan"
        )
    found = list(_by_fan(where, names, given).values())
    return dict(zip(fans, found * (len(fans) // len(found)), strict=True))


def _by_fan(where: str, names: Sequence[str], given: Sequence[str]) -> dict[int, str]:
    """The columns by the number of their fan: in the order given, or as a pattern has it."""
    if not _is_pattern(given, names):
        for name in given:
            require(where, names, name)
        return dict(enumerate(given))
    before, after = FAN_NUMBER.split(given[0], maxsplit=1)
    pattern = re.compile(rf"{re.escape(before)}(\d+){re.escape(after)}")
    found = {int(match[1]): name for name in names if (match := pattern.fullmatch(name))}
    if not found:
        raise UserError(f"{where}: no column matches {given[0]}; {_there_are(names, given[0])}")
    return dict(sorted(found.items()))


def _there_are(names: Sequence[str], given: str) -> str:
    close = difflib.get_close_matches(given, names, n=3, cutoff=0.5)
    if close:
        return f"did you mean {' or '.join(map(repr, close))}?"
    known = list(filter(None, names))
    more = " and more; --preview shows them" if len(known) > MOST_SHOWN else ""
    return f"it has {', '.join(known[:MOST_SHOWN])}{more}"
