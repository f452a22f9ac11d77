"""What would tell the cause of an alarm, where the last seconds do not: from what they lack.

The causes differ in how they change with the speed (docs/explanation/diagnosis.md), so what is missing is motion: a
change of the speed by a third, beyond the speeds that were seen. The command for it follows from the healthy balance.
A fan that does not turn shows nothing; whether it should turn says where to look.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from scoring.diagnosis.regression_window import HealthyBalance, Window

SLOWER, FASTER = 2.0 / 3.0, 4.0 / 3.0
MIN_SPEEDS = 1.5
"""a speed to go to is at least so many times the lowest one at which the balance holds"""
SOON_S = 1.0
"""the next diagnoses come by themselves"""
QUANTILES = (0.05, 0.95)
DIGITS = 2

KNOWN_SOON = "more is known in a few seconds"


@dataclass(frozen=True)
class Advice:
    """Writes advice in the unit of the command; empty where the twin does not name it."""

    command_unit: str = ""
    lowest_command: float = 0.0
    """the lowest one that turns a healthy fan: none below it is advised"""
    highest_command: float = math.inf
    """the highest one that the twin knows: none above it is advised"""

    def added_to(self, unclear: str, window: Window, healthy: HealthyBalance) -> str:
        """Why the cause is unclear, with what would tell."""
        speed, acting = np.abs(window.speed_rad_s[window.onset :]), window.command[window.onset :]
        command = window.as_given.command[window.onset :]
        acting, given = acting[np.isfinite(acting)], command[np.isfinite(command)]
        if len(speed) * window.period_s < SOON_S:
            return f"{unclear}: {KNOWN_SOON}"
        if not np.isfinite(speed).any() or not len(given) or not len(acting):
            return unclear
        low, high = (float(np.nanquantile(speed, q)) for q in QUANTILES)
        if high <= healthy.lowest_speed_rad_s:
            now = float(np.median(given))
            if abs(np.median(acting)) > abs(_needed(healthy, window, MIN_SPEEDS * healthy.lowest_speed_rad_s)):
                return f"{unclear}: at {self._of(now)} it should turn: see whether it is free to turn and has power"
            target = max(_needed(healthy, window, 2.0 * MIN_SPEEDS * healthy.lowest_speed_rad_s), self.lowest_command)
            return f"{unclear}: it hardly turns: move the command to {self._of(min(target, self.highest_command))}"
        lowest, highest = (float(np.quantile(given, q)) for q in QUANTILES)
        command = lowest * _needed(healthy, window, SLOWER * low) / _needed(healthy, window, low)
        if SLOWER * low < MIN_SPEEDS * healthy.lowest_speed_rad_s or command < self.lowest_command:
            faster = highest * _needed(healthy, window, FASTER * high) / _needed(healthy, window, high)
            command = min(faster, self.highest_command)
        return f"{unclear}: move the command to {self._of(command)} for ten seconds, and back"

    def _of(self, command: float) -> str:
        size = abs(command)
        digits = max(DIGITS - 1 - math.floor(math.log10(size)), 0) if size > 0.0 else 0
        return f"{command:.{digits}f}{f' {self.command_unit}' if self.command_unit else ''}"


def _needed(healthy: HealthyBalance, window: Window, speed_rad_s: float) -> float:
    """The command that holds a speed."""
    torque = healthy.viscous * speed_rad_s + healthy.drag * speed_rad_s**2 + healthy.friction + window.fan_offset
    return max(torque, 1e-9)
