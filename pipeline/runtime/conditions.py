"""Supply voltage and air of a tray's fans, for a twin that needs them (schemas.reference_conditions)."""

from __future__ import annotations

from dataclasses import dataclass

from schemas.messages import Array, Grid
from schemas.reference_conditions import ConditionRatios, ReferenceConditions
from schemas.units import NS_PER_S
from scoring.column_state import ColumnState


@dataclass(frozen=True)
class Ratios:
    """Of a block, relative to the twin's reference conditions. All (n, fans)."""

    torque: Array
    """of a command"""
    density: Array
    """of the air"""
    known: Array
    """whether all that the twin needs is known"""

    @property
    def command(self) -> Array:
        """What converts a command to the reference conditions."""
        return self.torque * self.density


class ConditionTracker(ColumnState):
    """Follows what is measured; a value that is missing is held for a while. Does not depend on the cuts of blocks."""

    def __init__(self, reference: ReferenceConditions, fans: int) -> None:
        self.reference = reference
        self._ratios = ConditionRatios(reference, fans)

    def columns(self) -> dict[str, Array]:
        """See ColumnState."""
        return self._ratios.columns()

    def update(self, grid: Grid) -> Ratios:
        """Those of the next block."""
        return Ratios(*self._ratios.update(grid.t_ns / NS_PER_S, grid.supply_voltage_v, grid.temperature_c))

    def missing(self, grid: Grid) -> str:
        """The columns that the twin needs and the block does not have, with commas; empty if there are none."""
        return ", ".join(name for name in self.reference.needed if not len(getattr(grid, name)))
