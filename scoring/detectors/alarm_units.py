"""The units in which alarms are put into words, and the words for a shift of a residual."""

from __future__ import annotations

from dataclasses import dataclass

from schemas.messages import Alarm
from schemas.units import RAD_S_PER_UNIT, SpeedUnit


@dataclass(frozen=True)
class AlarmUnits:
    """The units of a tray."""

    speed: SpeedUnit
    command: str = ""
    """empty where the twin does not say"""

    def shown_speed(self, speed_rad_s: float) -> str:
        """A speed in the unit that people are shown, without the unit."""
        speed = speed_rad_s / RAD_S_PER_UNIT[self.speed]
        return f"{speed:.0f}" if speed >= 10 else f"{speed:.2g}"

    def shift(self, alarm: Alarm, source: str) -> str:
        """The distance of an alarm's residual from its baseline, and its limit."""
        if source == "speed":
            side = "below" if alarm.residual_rad_s < 0 else "above"
            size, limit = self.shown_speed(abs(alarm.residual_rad_s)), self.shown_speed(alarm.limit_rad_s)
            return f"{size} {self.speed} {side} the twin (limit {limit})"
        side = "more" if alarm.torque_balance_command > 0 else "less"
        size, limit = abs(alarm.torque_balance_command), alarm.torque_balance_limit_command
        return f"takes {size:.2g} {self.command or 'of command'} {side} than a healthy one (limit {limit:.2g})"
