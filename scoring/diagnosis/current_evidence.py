"""What a measured current says of the cause: whether the drive still gives the voltage that is commanded.

The current of a motor is (voltage - back EMF) / resistance: a linear function of the acting command and of the speed,
whatever load turns with it. It is fitted to the healthy seconds of the window before the onset. A load that brakes the
rotor (drag, friction, something that touches it) lowers the speed and raises the current as this function says. A drive
that gives less voltage takes less current than it says, in proportion to the command: so the current alone gives the
change of the gain, and how well it is known. Where the commands before the onset did not move, it is hardly known.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from scoring.diagnosis.regression_window import MEAN_OVER_S, Array, HealthyBalance, Window, acting_command

MIN_ROWS_BEFORE, MIN_ROWS_AFTER = 40, 4
"""means of MEAN_OVER_S"""
LEAST_MOVED = 0.1
"""the commands before the onset must differ by this share: otherwise command and speed cannot be separated"""
CLEAR_OF_ONSET_S = 1.0
"""the fault may have begun so long before the onset that was found, and the current needs as long to follow"""
CORRELATED = 3.0
"""so many successive means count as one"""
MODEL_ERROR = 0.02
"""standard deviation of a gain that the current shows of a healthy drive, beside noise"""
SIGNIFICANT = 4.0
"""standard errors from zero at which the current is known to follow the command"""
STRONGEST = 8.0
"""largest log likelihood ratio: no sensor is trusted further"""


@dataclass(frozen=True)
class GainOfCurrent:
    """The relative change of the gain that the current shows, and its standard error."""

    change: float
    std_error: float

    def log_ratio(self, size: float, size_std: float) -> float:
        """Log likelihood ratio of a gain that changed by about `size` to one that did not change."""
        spread = math.hypot(self.std_error, size_std)
        changed = -0.5 * ((self.change - size) / spread) ** 2 - math.log(spread)
        unchanged = -0.5 * (self.change / self.std_error) ** 2 - math.log(self.std_error)
        return float(np.clip(changed - unchanged, -STRONGEST, STRONGEST))


def gain_of_current(window: Window, healthy: HealthyBalance) -> GainOfCurrent | None:
    """None where the current is not measured, or does not say enough."""
    current = window.current_a
    if current is None or not np.isfinite(current).any() or not np.isfinite(window.command[0]):
        return None
    command = np.where(np.isfinite(window.command), window.command, 0.0)
    acting = acting_command(command, window.period_s, healthy.lag_s)
    acting[~np.isfinite(window.command)] = np.nan
    rows, at = _means(np.stack((acting, window.speed_rad_s, np.ones_like(acting), current)), window)
    before, after = rows[at < -CLEAR_OF_ONSET_S], rows[at > CLEAR_OF_ONSET_S]
    if len(before) < MIN_ROWS_BEFORE or len(after) < MIN_ROWS_AFTER:
        return None
    x, y = before[:, :3], before[:, 3]
    if np.ptp(x[:, 0]) < LEAST_MOVED * np.abs(x[:, 0]).max():
        return None
    scale = np.maximum(np.abs(x).max(axis=0), 1e-12)
    inverse: Any = np.linalg.pinv((x / scale).T @ (x / scale), rcond=1e-9)
    coefficients = inverse @ (x / scale).T @ y / scale
    variance = CORRELATED * float(np.square(y - x @ coefficients).sum()) / (len(y) - 3)
    covariance = variance * inverse / np.outer(scale, scale)
    by_command = float(coefficients[0])
    if not by_command > SIGNIFICANT * math.sqrt(covariance[0, 0]):
        return None
    expected, direction = after[:, :3] @ coefficients, by_command * after[:, 0]
    power = float(direction @ direction)
    if not power > 0.0:
        return None
    leverage = direction @ after[:, :3]
    error = math.sqrt(variance * power + float(leverage @ covariance @ leverage)) / power
    return GainOfCurrent(float(direction @ (after[:, 3] - expected)) / power, math.hypot(error, MODEL_ERROR))


def _means(columns: Array, window: Window) -> tuple[Array, Array]:
    """(rows, columns) means over MEAN_OVER_S where all is known, and their times, s after the onset."""
    per_row = max(1, round(MEAN_OVER_S / window.period_s))
    count = columns.shape[1] // per_row
    rows = columns[:, : count * per_row].reshape(len(columns), count, per_row).mean(axis=2).T
    at_s: Array = (per_row * np.arange(count) + per_row / 2 - window.onset) * window.period_s
    known = np.isfinite(rows).all(axis=1)
    return rows[known], at_s[known]
