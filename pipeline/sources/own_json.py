"""Values in the form of the devices themselves: where in their JSON they are, and numbers as they write them."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any, Self

from pydantic import BaseModel, Field, model_validator

from fantwin.pipeline.errors import UserError
from fantwin.schemas.units import RAD_S_PER_UNIT

LONGEST_NUMBER = 40
"""characters"""
_FAN = re.compile(r"\{(\d+)\}")
"""the place of the number of a fan in a topic or pointer, with that of the tray's first fan"""
_NUMBER = re.compile(r"([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(1/min|\D{0,8})")
_NONE = ("", "null", "nan", "none", "unavailable", "unknown", "offline")
_SWITCHED = {"on": True, "true": True, "off": False, "false": False}
_UNITS = {"rpm": "rpm", "1/min": "rpm", "r/min": "rpm", "min-1": "rpm", "u/min": "rpm", "rad/s": "rad/s"}
MOST_KEYS_SHOWN = 8


class OwnJson(BaseModel, frozen=True):
    """Pointers into JSON of the device's own form, `/fans/{0}/rpm` with the number of the first fan in braces."""

    speed_key: str = Field(
        default="", pattern="^(/.*)?$", description="where the speed is in the device's own JSON (JSON pointer)"
    )
    command_key: str = Field(default="", pattern="^(/.*)?$", description="where its command is")


class OwnSamples(OwnJson, frozen=True):
    """Whole samples in such JSON."""

    time_key: str = Field(
        default="",
        pattern="^(/.*)?$",
        description="where its time is, s since 1970 or a date; without it, that of receipt",
    )

    @model_validator(mode="after")
    def _has_speed_and_command(self) -> Self:
        if bool(self.speed_key) != bool(self.command_key) or (self.time_key and not self.speed_key):
            raise ValueError("give speed_key and command_key, or neither, and time_key only with them")
        return self

    def require_each_fan(self, fans: int) -> None:
        """Raises UserError if one speed would be that of several fans."""
        if fans > 1 and self.speed_key and not is_of_each_fan(self.speed_key):
            raise UserError(f"speed_key has one speed for {fans} fans: number them in braces, as in /fans/{{0}}/rpm")


def of_fan(text: str, fan: int) -> str:
    """The topic or pointer of a fan of the tray, counted from 0."""
    return _FAN.sub(lambda first: str(int(first[1]) + fan), text)


def is_of_each_fan(text: str) -> bool:
    """Whether each fan has one of its own."""
    return _FAN.search(text) is not None


def has_other_braces(text: str) -> bool:
    """Whether braces hold anything else than a number."""
    return bool(set("{}") & set(_FAN.sub("", text)))


class NothingThereError(ValueError):
    """JSON has no value at a pointer: one line with what it has."""


def value_at(value: Any, pointer: str) -> Any:
    """The value at a JSON pointer (RFC 6901). Raises NothingThereError."""
    is_there, found = _at(value, pointer)
    if is_there:
        return found
    there = list(map(str, found)) if isinstance(found, Mapping) else []
    more = ", ..." if len(there) > MOST_KEYS_SHOWN else ""
    raise NothingThereError(f"nothing at {pointer}; there is: {', '.join(there[:MOST_KEYS_SHOWN])}{more}")


def found_at(value: Any, pointer: str) -> Any:
    """The value at a JSON pointer, None if there is nothing."""
    is_there, found = _at(value, pointer)
    return found if is_there else None


def has(value: Any, pointer: str) -> bool:
    """Whether there is a value at a JSON pointer, also null."""
    return _at(value, pointer)[0]


def number_at(value: Any, pointer: str) -> float:
    """The finite number at a JSON pointer, which may be text; NaN if there is none, or no pointer."""
    number = number_of(found_at(value, pointer)) if pointer else None
    return math.nan if number is None or math.isinf(number) else number


def _at(value: Any, pointer: str) -> tuple[bool, Any]:
    """Whether there is a value at a pointer, and it; or the last value on the way there."""
    here = value
    for key in _keys_of(pointer):
        if isinstance(here, Mapping) and key in here:
            here = here[key]
        elif isinstance(here, Sequence) and not isinstance(here, str) and key.isdecimal() and int(key) < len(here):
            here = here[int(key)]
        else:
            return False, here
    return True, here


@lru_cache(maxsize=1024)
def _keys_of(pointer: str) -> tuple[str, ...]:
    return tuple(part.replace("~1", "/").replace("~0", "~") for part in pointer.split("/")[1:])


def number_of(value: Any, *, speed_unit: str = "", on: float = math.nan) -> float | None:
    """The number that a device writes; NaN where it says that there is none, None where it is no number.

    speed_unit: of the tray, to which a speed with its unit is converted; empty for a command, whose unit says nothing.
    on: the command of a fan that is switched on, for values such as ON and true; NaN: they are no number.
    """
    if isinstance(value, int | float) and not isinstance(value, bool):
        try:
            return float(value)
        except OverflowError:
            return None
    text = "" if value is None else str(value).strip().lower() if isinstance(value, str | bool) else "-"
    if text in _NONE:
        return math.nan
    if text in _SWITCHED and not math.isnan(on):
        return on if _SWITCHED[text] else 0.0
    found = _NUMBER.fullmatch(text if len(text) <= LONGEST_NUMBER else "-")
    unit = found[2].strip() if found else "-"
    if found is None or (speed_unit and unit and unit not in _UNITS):
        return None
    factor = RAD_S_PER_UNIT[_UNITS[unit]] / RAD_S_PER_UNIT[speed_unit] if unit and speed_unit else 1.0
    return float(found[1]) * factor


def is_switched_on(value: Any) -> bool | None:
    """Whether a fan is on, by values such as ON, off, true and 0; None where that is not said."""
    text = str(value).strip().lower()
    if text in _SWITCHED:
        return _SWITCHED[text]
    number = number_of(value)
    return None if number is None or math.isnan(number) else number != 0.0
