"""Fans in a line for people: by their names, and by their numbers, which are short also for a large tray."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass

LONGEST_NAME = 60
"""characters of a name or a place"""
MOST_LISTED = 8
"""fans that are listed one by one"""
MOST_RUNS = 8
"""runs of neighbouring fans that are named"""


def is_one_short_line(text: str) -> bool:
    """Whether a name or a place can be shown anywhere."""
    return len(text) <= LONGEST_NAME and text.isprintable() and text == text.strip()


def is_fan_name(text: str) -> bool:
    """Whether a text can name a fan: it is no number, and not `all`, which commands would take for other fans."""
    return bool(text) and is_one_short_line(text) and not text.isdecimal() and text.casefold() != "all"


def fan_label(number: int, name: str = "") -> str:
    """`CPU (fan 0)`; without a name `fan 0`."""
    return f"{name} (fan {number})" if name else f"fan {number}"


def fan_cell(number: int, name: str = "") -> str:
    """A fan in a column of fans: `CPU (fan 0)`; without a name `0`."""
    return fan_label(number, name) if name else str(number)


@dataclass(frozen=True)
class FanNames:
    """Names of the fans of a tray, by number; a fan without one has an empty name, or is beyond the end."""

    names: tuple[str, ...] = ()

    def name(self, fan: int) -> str:
        """Name of a fan; empty without one."""
        return self.names[fan] if 0 <= fan < len(self.names) else ""

    def label(self, fan: int) -> str:
        """See `fan_label`."""
        return fan_label(fan, self.name(fan))

    def labels(self, fans: Sequence[int]) -> str:
        """`CPU (fan 0), fan 3`; without names `fans 0, 3`, and of more than a few fans `fans 0 to 39, 57`.

        fans: at least one, in rising order.
        """
        if len(fans) <= MOST_LISTED and any(map(self.name, fans)):
            return ", ".join(map(self.label, fans))
        return f"{'fan' if len(fans) == 1 else 'fans'} {fans_in_words(fans)}"

    def cell(self, fan: int) -> str:
        """See `fan_cell`."""
        return fan_cell(fan, self.name(fan))

    def number(self, text: str) -> int:
        """The fan that a user means by its number, name or label, in capitals or not. A number may be too large.

        Raises:
            ValueError: no fan has this name; the message says which there are.
        """
        wanted = text.strip().casefold()
        if wanted.removeprefix("-").isdecimal():
            return int(wanted)
        named = [fan for fan, name in enumerate(self.names) if name]
        for fan in named:
            if wanted in (self.name(fan).casefold(), self.label(fan).casefold()):
                return fan
        if not named:
            raise ValueError(f"no fan called {text!r}: the fans have no names; give a number, counted from 0")
        raise ValueError(f"no fan called {text!r}; there are {self.all_in_words()}")

    def all_in_words(self) -> str:
        """Those that have a name, of many the first; empty: none."""
        named = [self.label(fan) for fan, name in enumerate(self.names) if name]
        more = f" and {len(named) - MOST_LISTED} more" if len(named) > MOST_LISTED else ""
        return f"{', '.join(named[:MOST_LISTED])}{more}"

    def as_json(self) -> str:
        """The names for the metadata of a recording."""
        return json.dumps(self.names, ensure_ascii=False)

    @classmethod
    def from_json(cls, text: str) -> FanNames:
        """The names in metadata, which anybody may have written: without those that cannot be shown."""
        try:
            found = json.loads(text)
        except ValueError:
            return cls()
        names = found if isinstance(found, list) else []
        return cls(tuple(each if isinstance(each, str) and is_one_short_line(each) else "" for each in names))


NO_NAMES = FanNames()


def fans_in_words(fans: Sequence[int]) -> str:
    """`0, 3, 5`; of more than a few fans runs of neighbours, `0 to 39, 57`, and of many runs the first ones.

    fans: at least one, in rising order.
    """
    if len(fans) <= MOST_LISTED:
        return ", ".join(map(str, fans))
    runs: list[list[int]] = []
    for fan in fans:
        if runs and fan == runs[-1][-1] + 1:
            runs[-1].append(fan)
        else:
            runs.append([fan])
    named = ", ".join(str(run[0]) if len(run) == 1 else f"{run[0]} to {run[-1]}" for run in runs[:MOST_RUNS])
    others = sum(map(len, runs[MOST_RUNS:]))
    return f"{named} and {others} more" if others else named
