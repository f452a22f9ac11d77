"""Units as tables write them: at the end of a name, in a line of their own, or behind each number."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

from fantwin.schemas.units import NS_PER_S, RAD_S_PER_UNIT

RAD_S_PER_TABLE_UNIT = {**RAD_S_PER_UNIT, "hz": 2 * math.pi, "deg/s": math.pi / 180}
ELECTRICAL, ELECTRICAL_HUNDREDS = "erpm", "erpm/100"
"""electrical revolutions a minute, which need the number of poles"""
SPEED_UNITS = (*RAD_S_PER_TABLE_UNIT, ELECTRICAL, ELECTRICAL_HUNDREDS)
NS_PER_UNIT = {"s": NS_PER_S, "ms": 1_000_000, "us": 1_000, "ns": 1}

_SPEEDS = {
    "rpm": ("rpm", "r/min", "rev/min", "u/min", "1/min", "min-1", "min^-1", "tr/min", "g/min", "omw/min"),
    "rad/s": ("rad/s", "rad/sec", "rad s-1"),
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
}


@dataclass(frozen=True)
class Scale:
    """How values in a unit become those of a channel: `value * factor + offset`."""

    factor: float
    offset: float = 0.0


CHANNEL_SCALES = {
    "supply_voltage_v": {"v": Scale(1.0), "volt": Scale(1.0), "volts": Scale(1.0), "mv": Scale(1e-3)},
    "current_a": {"a": Scale(1.0), "amp": Scale(1.0), "amps": Scale(1.0), "ma": Scale(1e-3)},
    "temperature_c": {
        **dict.fromkeys(("c", "°c", "ºc", "degc", "celsius"), Scale(1.0)),
        **dict.fromkeys(("f", "°f", "ºf", "degf", "fahrenheit"), Scale(5 / 9, -160 / 9)),
        "m°c": Scale(1e-3),
        "k": Scale(1.0, -273.15),
    },
}
_COMMANDS = ("%", "pct", "percent", "‰")
_OTHERS = ("w", "kw", "khz", "mhz", "ghz", "mb", "gb", "pa", "kpa", "gf", "kgf", "n", "nm", "n·m", "ω", "ohm", "db")
_OTHERS_TOO = ("lbf", "mah", "ah", "wh", "m/s", "mm", "kb/s", "mb/s", "yes/no", "fps")
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


def known_unit(text: str) -> str:
    """The unit that a text stands for, one of a speed or a time in one spelling; empty if it is none."""
    text = text.strip()
    return _KNOWN.get(text.lower(), "") and (_SPELLED.get(text.lower()) or text)


def is_unit(text: str) -> bool:
    """Whether a cell of a line holds a unit: one that is known, or any short text in brackets."""
    inside = text.strip("[]() ")
    return bool(known_unit(inside)) or (inside != text and len(inside) <= 8) or text in ("-", "–")


def unit_in_name(name: str) -> str:
    """The unit at the end of the name of a column, as in `Fan1 [RPM]`, `time (us)` or `speed_rpm`; empty: none."""
    found = _AT_END.search(name)
    if found is None:
        return ""
    text = found["in"] if found["in"] is not None else found["last"]
    unit = known_unit(text) or ("K" if found["in"] == "K" else "")
    if found["in"] is None and text.lower() in _LETTERS_IN_NAMES:
        return ""
    return unit


def scale_of(channel: str, unit: str) -> Scale | None:
    """How values of a column in this unit become those of a channel; None: the unit is not one of the channel."""
    return CHANNEL_SCALES[channel].get(unit.lower()) if channel in CHANNEL_SCALES else Scale(1.0)
