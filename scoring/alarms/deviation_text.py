"""Units of a tray for alarms: what the fault of an alarm takes, in numbers for people."""

from __future__ import annotations

from dataclasses import dataclass

from fantwin.schemas.messages import Alarm
from fantwin.schemas.units import RAD_S_PER_UNIT, SpeedUnit

SIGMAS = 2.0
"""half of the interval of a size"""


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

    def deviation(self, alarm: Alarm) -> str:
        """Deviation of a fan from its healthy state, by its speed or by its torque balance."""
        if alarm.residual_rad_s or not alarm.torque_balance_command:
            side = "slower" if alarm.residual_rad_s < 0 else "faster"
            size = self.shown_speed(abs(alarm.residual_rad_s))
            error = self.shown_speed(SIGMAS * alarm.residual_std_rad_s)
            return f"{size} {self.speed} {side} than when healthy (± {error})"
        side = "more" if alarm.torque_balance_command > 0 else "less"
        size, error = abs(alarm.torque_balance_command), SIGMAS * alarm.torque_balance_std_command
        return f"takes {size:.2g} {self.command or 'of command'} {side} than when healthy (± {error:.2g})"
