"""Limits at speeds that calibration has hardly seen, of fans whose tachos count and of which there are few data.

At other speeds than those of calibration a twin errs by more than calibration shows. How much more was found on a
simulated rack at 2 Hz, calibrated on ten minutes in which its fans held 40 to 75 % of full speed: without these limits
it had 45 false alarms a day at other speeds, with them one.
"""

from __future__ import annotations

from scoring.baseline.healthy_residual import HealthyResidual

WIDER = 2.5
"""times the limits at the nearest speed of calibration"""
DISTANCE = 0.1
"""of the top speed: so far from it limits have become so wide"""


def wider_at_unvisited_speeds(residual: HealthyResidual, top_speed_rad_s: float) -> HealthyResidual:
    """The same with limits that are wider below the lowest and above the highest of its speeds."""
    count, away_rad_s = len(residual.speeds_rad_s), DISTANCE * top_speed_rad_s
    lowest, highest = residual.speeds_rad_s[0] - away_rad_s, residual.speeds_rad_s[-1] + away_rad_s
    below = 1 if lowest > 0.0 else 0
    persistent = residual.persistent_std if len(residual.persistent_std) == count else residual.persistent_std * count
    return residual.model_copy(
        update={
            "speeds_rad_s": (*(lowest,) * below, *residual.speeds_rad_s, highest),
            "expected_residual_sigmas": _extended(residual.expected_residual_sigmas, below),
            "residual_std": _extended(residual.residual_std, below),
            "persistent_std": _extended(persistent, below, WIDER),
        }
    )


def _extended(values: tuple[float, ...], below: int, factor: float = 1.0) -> tuple[float, ...]:
    """The values with the outer ones times a factor once more at the end, and if `below` is 1 at the beginning."""
    return (*(factor * values[0],) * below, *values, factor * values[-1])
