"""The input of every competitor: both residuals of a prediction in healthy standard deviations, and moving windows."""

from __future__ import annotations

import numpy as np

from fantwin.schemas.enums import InvalidReason
from fantwin.schemas.messages import Array, Prediction


def speed_sigmas(block: Prediction) -> Array:
    """(n, fans) measured less predicted speed in the card's sigma; NaN where the sample is not valid."""
    residual = (block.measured_speed_rad_s - block.predicted_speed_rad_s) / block.sigma_rad_s
    return np.where(block.valid, residual, np.nan)


def balance_sigmas(block: Prediction) -> Array:
    """(n, fans) the torque balance in the card's sigma; NaN where it is not valid. It needs no free run to warm up."""
    valid = block.valid | (block.invalid_reason == InvalidReason.WARMING_UP)
    return np.where(valid, block.torque_balance_command / block.torque_balance_sigma_command, np.nan)


class Moving:
    """Means over the last `rows` samples, carried from block to block; NaN until half of them were there."""

    def __init__(self, rows: int) -> None:
        self._rows = rows
        self._before: Array | None = None

    def means(self, values: Array) -> Array:
        """(n, ...) mean of each sample and those before it. values: (n, ...), NaN where missing."""
        if self._before is None:
            self._before = np.full((self._rows - 1, *values.shape[1:]), np.nan)
        joined = np.concatenate((self._before, values))
        self._before = joined[len(values) :]
        known = np.isfinite(joined)
        start = np.zeros((1, *values.shape[1:]))
        sums = np.concatenate((start, np.cumsum(np.where(known, joined, 0.0), axis=0)))
        counts = np.concatenate((start, np.cumsum(known, axis=0)))
        total, count = sums[self._rows :] - sums[: -self._rows], counts[self._rows :] - counts[: -self._rows]
        return np.where(2 * count >= self._rows, total / np.maximum(count, 1.0), np.nan)
