"""Supply voltage and air of a tray's fans, for a twin that needs them (schemas.reference_conditions)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fantwin.schemas.fan_names import NO_NAMES, FanNames
from fantwin.schemas.messages import Array, Grid
from fantwin.schemas.reference_conditions import ConditionRatios, ReferenceConditions
from fantwin.schemas.units import NS_PER_S
from fantwin.scoring.column_state import NEVER_NS, ColumnState


@dataclass(frozen=True)
class Ratios:
    """Ratios of a block to the twin's reference conditions. All (n, fans)."""

    torque: Array
    """torque of a command"""
    density: Array
    """density of the air"""
    known: Array
    """true where all that the twin needs is known"""

    @property
    def command(self) -> Array:
        """Factor that converts a command to the reference conditions."""
        return self.torque * self.density


SHOWN_NS = 5 * NS_PER_S
"""time for which a problem names a fan that conditions took out of the twin's range"""


class ConditionTracker(ColumnState):
    """Follows what is measured; a value that is missing is held for a while. Does not depend on the cuts of blocks."""

    def __init__(self, reference: ReferenceConditions, fans: int, names: FanNames = NO_NAMES) -> None:
        self.reference, self._names = reference, names
        self._ratios = ConditionRatios(reference, fans)
        self._beyond_t_ns = np.full(fans, NEVER_NS)
        """time of the last sample that the conditions alone took out of the twin's range, and the ratio of torque
        there"""
        self._beyond_torque = np.ones(fans)

    def columns(self) -> dict[str, Array]:
        """See ColumnState."""
        beyond = {"beyond_t_ns": self._beyond_t_ns, "beyond_torque": self._beyond_torque}
        return {**self._ratios.columns(), **beyond}

    def note_beyond(self, t_ns: Array, torque: Array, beyond: Array) -> None:
        """Note where the conditions alone take commands out of the twin's range: (n, fans) of bool; torque: the
        ratio."""
        fans = np.flatnonzero(np.any(beyond, axis=0))
        last = len(beyond) - 1 - np.argmax(beyond[::-1, fans], axis=0)
        self._beyond_t_ns[fans] = t_ns[last]
        self._beyond_torque[fans] = torque[last, fans]

    def problem(self, t_ns: int) -> str:
        """Name the fans that the conditions have just taken out of the twin's range; empty for none."""
        fans = np.flatnonzero(self._beyond_t_ns > t_ns - SHOWN_NS)
        if not len(fans):
            return ""
        subject = f"{self._names.labels(fans.tolist())} {'is' if len(fans) == 1 else 'are'}"
        voltage_v, cause = self.reference.supply_voltage_v, "the temperature of the air takes"
        if voltage_v is not None:
            found_v = voltage_v * self._beyond_torque[fans].mean()
            cause = f"a supply of {found_v:.2g} V, where the twin's reference is {voltage_v:.3g} V, takes"
        return f"{subject} not scored: {cause} the command out of the twin's range"

    def update(self, grid: Grid) -> Ratios:
        """Ratios of the next block."""
        return Ratios(*self._ratios.update(grid.t_ns / NS_PER_S, grid.supply_voltage_v, grid.temperature_c))

    def missing(self, grid: Grid) -> str:
        """The columns that the twin needs and the block does not have, with commas; empty if there are none."""
        return ", ".join(name for name in self.reference.needed if not len(getattr(grid, name)))
