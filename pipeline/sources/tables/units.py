"""Units as tables write them: at the end of a name, in a line of their own, or behind each number."""

from __future__ import annotations

import math
import re
from typing import NamedTuple

import numpy as np

from fantwin.pipeline.errors import UsageError
from fantwin.schemas.channels import BY_NAME
from fantwin.schemas.messages import Array
from fantwin.schemas.units import NS_PER_S, RAD_S_PER_UNIT

RAD_S_PER_TABLE_UNIT = {**RAD_S_PER_UNIT, "hz": 2 * math.pi, "deg/s": math.pi / 180}
ELECTRICAL, ELECTRICAL_HUNDREDS = "erpm", "erpm/100"
"""electrical revolutions a minute, which need the number of poles"""
_THOUSANDS = "krpm"
SPEED_UNITS = (*RAD_S_PER_TABLE_UNIT, _THOUSANDS, ELECTRICAL, ELECTRICAL_HUNDREDS)
NS_PER_UNIT = {"s": NS_PER_S, "ms": 1_000_000, "us": 1_000, "ns": 1, "min": 60 * NS_PER_S, "h": 3600 * NS_PER_S}

_SPEEDS = {
    "rpm": ("rpm", "r/min", "rev/min", "u/min", "1/min", "min-1", "min^-1", "tr/min", "g/min", "omw/min"),
    _THOUSANDS: ("krpm", "rpm x1000", "1000 rpm"),
    "rad/s": ("rad/s", "rad/sec", "rad s-1", "rad.s", "rad.s-1", "rad·s-1"),
    "hz": ("hz", "rps", "1/s", "rev/s", "r/s"),
    "deg/s": ("deg/s", "°/s", "deg/sec", "dps"),
    ELECTRICAL: ("erpm",),
    ELECTRICAL_HUNDREDS: ("erpm/100",),
}
_TIMES = {
    "s": ("s", "sec", "secs", "second", "seconds", "sek", "epoch s"),
    "ms": ("ms", "msec", "millis", "milliseconds", "millisecond"),
    "us": ("us", "µs", "μs", "usec", "micros", "microseconds", "microsecond"),
    "ns": ("ns", "nsec", "nanos", "nanoseconds"),
    "min": ("min", "mins", "minute", "minutes"),
    "h": ("h", "hr", "hrs", "hour", "hours"),
}


class Scale(NamedTuple):
    """How values in a unit become those of a channel: `value * factor + offset`."""

    factor: float = 1.0
    offset: float = 0.0


CHANNEL_SCALES = {
    "supply_voltage_v": {"v": Scale(), "volt": Scale(), "volts": Scale(), "mv": Scale(1e-3), "v/100": Scale(1e-2)},
    "current_a": {"a": Scale(), "amp": Scale(), "amps": Scale(), "ma": Scale(1e-3)},
    "temperature_c": {
        **dict.fromkeys(("c", "°c", "ºc", "degc", "deg c", "celsius"), Scale()),
        **dict.fromkeys(("f", "°f", "ºf", "degf", "fahrenheit"), Scale(5 / 9, -160 / 9)),
        **dict.fromkeys(("m°c", "mc"), Scale(1e-3)),
        "k": Scale(1.0, -273.15),
    },
}
_COMMANDS = ("%", "pct", "percent", "‰")
_OTHERS = ("w", "kw", "khz", "mhz", "ghz", "mb", "gb", "pa", "kpa", "gf", "kgf", "n", "nm", "n·m", "ω", "ohm", "db")
_OTHERS_TOO = (
    "lbf",
    "mah",
    "ah",
    "wh",
    "m/s",
    "mm",
    "kb/s",
    "mb/s",
    "yes/no",
    "fps",
    "n.m",
    "n.mm",
    "n·mm",
    "bar",
    "m3/h",
)
"""no k, m, g, b or t: behind a number they may be thousands, millions and more"""
_SPELLED = {word: unit for units in (_SPEEDS, _TIMES) for unit, words in units.items() for word in words}
_KNOWN = {
    **_SPELLED,
    **{word: word for scales in CHANNEL_SCALES.values() for word in scales if word != "k"},
    **{word: word for word in (*_COMMANDS, *_OTHERS, *_OTHERS_TOO)},
}
_AT_END = re.compile(r"(?:[\[(]\s*(?P<in>[^\[\]()]*?)\s*[\])]|(?:_|\s-\s|,\s|\s/\s)(?P<last>[^\s_,\[\]()]+))\s*$")
_LETTERS_IN_NAMES = {"f", "n", "w"}
"""no units behind an underscore"""
_SPEED_IN_NAME = re.compile(
    r"(?:(?<![A-Za-z])|(?<=[a-z])(?=RPM))(?P<e>[eE]?)(?:[Rr]pm|RPM)(?![a-z])|(?P<angle>rad|deg)(?:[_/]|_?per_?)s(?:ec)?$"
)
_TAGS = re.compile(r"\{.*\}$")


def known_unit(text: str) -> str:
    """The unit that a text stands for, one of a speed or a time in one spelling; empty if it is none."""
    text = text.strip()
    return _KNOWN.get(text.lower(), "") and (_SPELLED.get(text.lower()) or text)


def is_unit(text: str) -> bool:
    """Whether a cell of a line holds a unit: one that is known, or any short text in brackets."""
    inside = text.strip("[]() ")
    return bool(known_unit(inside)) or (text[0] in "[(" and len(inside) <= 8) or text in ("-", "–")


def unit_in_name(name: str) -> str:
    """The unit in the name of a column or series: in brackets at its end, as in `time (us)`, else rpm anywhere, else at
    its end, as in `duty_pct{a=b}` or `speed_rad_s`; empty: none."""
    name = _TAGS.sub("", name)
    found = _AT_END.search(name)
    if found and found["in"] and (unit := "K" if found["in"] == "K" else known_unit(found["in"])):
        return unit
    if speed := _SPEED_IN_NAME.search(name):
        return f"{speed['angle']}/s" if speed["angle"] else ELECTRICAL if speed["e"] else "rpm"
    last = (found["last"] or "") if found else ""
    return "" if last.lower() in _LETTERS_IN_NAMES else known_unit(last)


def in_unit_of(channel: str, name: str, values: Array, unit: str) -> tuple[Array, str]:
    """The values of a column in the unit of its channel, NaN where theirs is of another kind; and a note on either."""
    if not unit or channel not in CHANNEL_SCALES:
        return values, ""
    scale = CHANNEL_SCALES[channel].get(unit.lower())
    if scale is None:
        return np.full_like(values, np.nan), f"{name!r} is in {unit}, which is no unit of {channel}: left out"
    if scale == Scale():
        return values, ""
    return values * scale.factor + scale.offset, f"{name!r} converted from {unit} to {BY_NAME[channel].unit}"


def rad_s_per(unit: str, poles: int | None) -> tuple[float, str]:
    """rad/s of one unit, and the unit that people are shown. poles: magnetic ones, for electrical speeds."""
    if unit == _THOUSANDS:
        return 1000.0 * RAD_S_PER_TABLE_UNIT["rpm"], "rpm"
    if unit not in (ELECTRICAL, ELECTRICAL_HUNDREDS):
        return RAD_S_PER_TABLE_UNIT[unit], unit
    if poles is None:
        raise UsageError(
            "speeds in erpm are electrical revolutions: give the magnetic poles of the motor, for example --poles 14"
        )
    if poles < 2 or poles % 2:
        raise UsageError(f"--poles {poles}: magnetic poles come in pairs, for example 14")
    return (100.0 if unit == ELECTRICAL_HUNDREDS else 1.0) * RAD_S_PER_TABLE_UNIT["rpm"] / (poles / 2), "rpm"
