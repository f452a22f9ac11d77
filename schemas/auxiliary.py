"""What a source may measure beside command and speed: supply voltage, current and temperature of each fan.

Each is an optional column, `samples x fans`, of `Raw` and of what is made from it. An empty column means that the
source does not measure it, NaN that the value is not known. Whatever handles them loops over `AUXILIARY`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, slots=True)
class AuxiliaryColumn:
    """One measured quantity beside command and speed.

    Attributes:
        name: of its field in messages and readings, and of its column in tables, with the unit.
        letter: begins its group in a text line of the wire protocol.
        lowest, highest: a value beyond them is not plausible, in its unit.
        title: what people call it.
        unit: as people read it.
    """

    name: str
    letter: str
    lowest: float
    highest: float
    title: str
    unit: str

    def is_plausible(self, value: float) -> bool:
        """Whether a value can be true; NaN, an unknown one, cannot."""
        return self.lowest <= value <= self.highest


AUXILIARY = (
    AuxiliaryColumn("supply_voltage_v", "V", 0.0, 2000.0, "supply voltage", "V"),
    AuxiliaryColumn("current_a", "I", -1000.0, 1000.0, "current", "A"),
    AuxiliaryColumn("temperature_c", "T", -100.0, 300.0, "temperature", "°C"),
)
"""in the order of their bits in a binary frame: never reorder, only append"""


TITLES = {column.name: column.title for column in AUXILIARY}
_LEAST_REACH = 0.02
"""least half-height of the axis of a plot, as a share of the largest value"""


def axis_range(lowest: float, highest: float) -> tuple[float, float]:
    """The range of an axis for values from lowest to highest, on which noise looks small."""
    middle = (lowest + highest) / 2.0
    reach = max(0.55 * (highest - lowest), _LEAST_REACH * max(abs(lowest), abs(highest)))
    return middle - reach, middle + reach


def auxiliary_columns(message: Any) -> dict[str, Any]:
    """The columns that a message, or a record with the same names, has, by name; those that are empty are left out.

    They are arrays, `samples x fans`: `Any`, so that a message can be made with `**auxiliary_columns(other)`.
    """
    return {column.name: values for column in AUXILIARY if len(values := getattr(message, column.name))}
