"""Advice on what would tell the cause of an alarm, if what was seen since its onset does not.

Causes differ in how they change with the speed (docs/explanation/diagnosis.md), so what is missing is motion: a change
of the speed by a third, beyond the speeds that were seen. The command for it follows from the healthy torque balance.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from fantwin.scoring.diagnosis.steady_fan import SteadyFan

SLOWER, FASTER = 2.0 / 3.0, 4.0 / 3.0
DIGITS = 2

KNOWN_SOON = "more is known in a few seconds"


@dataclass(frozen=True)
class SeenSinceOnset:
    """Summary of what a fan did since the onset of its alarm."""

    lowest_rad_s: float
    highest_rad_s: float
    lowest_command: float
    highest_command: float


@dataclass(frozen=True)
class Advice:
    """Writes advice in the unit of the command; empty where the twin does not name it."""

    command_unit: str = ""
    lowest_command: float = 0.0
    """the lowest one that turns a healthy fan: none below it is advised"""
    highest_command: float = math.inf
    """the highest one that the twin knows: none above it is advised"""

    def added_to(self, unclear: str, seen: SeenSinceOnset, fan: SteadyFan) -> str:
        """Why the cause is unclear, with what would tell."""
        command = self._other_command(seen, fan)
        if not math.isfinite(command):
            return unclear
        return f"{unclear}: move the command to {self._of(command)} for ten seconds, and back"

    def _other_command(self, seen: SeenSinceOnset, fan: SteadyFan) -> float:
        """Find a command that gives a lower speed or, where that turns no fan, a higher one; NaN where there is
        neither."""
        low, high = seen.lowest_rad_s, seen.highest_rad_s
        if not 0.0 < low <= high < math.inf:
            return math.nan
        slower = seen.lowest_command * fan.needed(SLOWER * low) / fan.needed(low)
        if slower >= self.lowest_command:
            return slower
        faster = seen.highest_command * fan.needed(FASTER * high) / fan.needed(high)
        faster = min(faster, self.highest_command)
        return faster if faster > seen.highest_command else math.nan

    def _of(self, command: float) -> str:
        size = abs(command)
        digits = max(DIGITS - 1 - math.floor(math.log10(size)), 0) if size > 0.0 else 0
        return f"{command:.{digits}f}{f' {self.command_unit}' if self.command_unit else ''}"
