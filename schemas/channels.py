"""The table of channels: what is measured of a fan beside command and speed, one row each.

A row of `Measured` and one field of the message `Measured` in `fan.proto` are all that a new channel needs: sources,
wire protocol, grid, recordings, exports, page, metrics and Rerun derive what they do with it from here. Command and
speed are no rows: every source has them, and their units and ranges are those of the tray.

A channel is an optional column, `samples x fans`, of `Raw` and of what is made from it. An empty column means that the
source does not measure it, NaN that the value is not known.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any, Literal

import numpy as np

from fantwin.schemas.fields import Array, Column

Interpolation = Literal["linear", "hold"]
FanValues = Mapping[str, tuple[float, ...]]
"""values of one sample by the name of their channel, one for each fan, NaN where it is not known"""


@dataclass(frozen=True, slots=True)
class Channel:
    """One row.

    Attributes:
        name: of its column in messages, tables and payloads, with the unit.
        title: what people call it.
        unit: as people read it.
        letter: begins its group in a text line of the wire protocol; one that no other row has, and none of S, C and P,
            which begin lines.
        lowest, highest: a value beyond them is not plausible, in its unit.
        interpolation: on the grid, `linear` between two samples that have a value; otherwise, and with `hold`, the last
            value counts until the next sample.
    """

    name: str
    title: str
    unit: str
    letter: str
    lowest: float
    highest: float
    interpolation: Interpolation = "linear"

    def is_plausible(self, value: float) -> bool:
        """Whether a value can be true; NaN, an unknown one, cannot."""
        return self.lowest <= value <= self.highest

    @property
    def key(self) -> str:
        """The title as one word, for settings, options and counters: `supply_voltage`."""
        return self.title.replace(" ", "_")

    @property
    def label(self) -> str:
        """Title and unit, as over an axis."""
        return f"{self.title}, {self.unit}"


def channel(
    title: str, unit: str, letter: str, lowest: float, highest: float, interpolation: Interpolation = "linear"
) -> Any:
    """Declare a row; see `Channel`."""
    declared = Column("samples x fans", np.dtype(np.float32), optional=True, part="measured")
    row = (title, unit, letter, lowest, highest, interpolation)
    return field(default_factory=lambda: np.zeros(0, np.float32), metadata={"column": declared, "channel": row})


@dataclass(frozen=True, eq=False, kw_only=True)
class Measured:
    """What a source may measure beside command and speed; messages that carry it extend this.

    The order is that of the eight bits in a binary frame of the wire protocol: a new channel comes last.
    """

    supply_voltage_v: Array = channel("supply voltage", "V", "V", 0.0, 2000.0)
    current_a: Array = channel("current", "A", "I", -1000.0, 1000.0)
    temperature_c: Array = channel("temperature", "°C", "T", -100.0, 300.0)


CHANNELS = tuple(Channel(row.name, *row.metadata["channel"]) for row in fields(Measured))
if len(CHANNELS) > 8 or len({"S", "C", "P"} | {each.letter for each in CHANNELS}) != 3 + len(CHANNELS):
    raise ValueError("a frame has eight channels at most, each with a letter of its own other than S, C and P")
SUPPLY_VOLTAGE, CURRENT, TEMPERATURE = "supply_voltage_v", "current_a", "temperature_c"
"""names of the channels that single sources and twins have a rule for"""
BY_NAME = {each.name: each for each in CHANNELS}
_LEAST_REACH = 0.02
"""least half-height of the axis of a plot, as a share of the largest value"""


def axis_range(lowest: float, highest: float) -> tuple[float, float]:
    """The range of an axis for values from lowest to highest, on which noise looks small."""
    middle = (lowest + highest) / 2.0
    reach = max(0.55 * (highest - lowest), _LEAST_REACH * max(abs(lowest), abs(highest)))
    return middle - reach, middle + reach


def measured_columns(message: Measured) -> dict[str, Any]:
    """The channels that a message has, by name; those that are empty are left out.

    They are arrays, `samples x fans`: `Any`, so that a message can be made with `**measured_columns(other)`.
    """
    return {each.name: values for each in CHANNELS if len(values := getattr(message, each.name))}
