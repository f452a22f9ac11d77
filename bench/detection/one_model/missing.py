"""Missing readings: a loose wire against a healthy line, whose losses may come in bursts."""

from __future__ import annotations

import numpy as np

from schemas.messages import Array

SHARES = np.array([0.03, 0.07, 0.15, 0.35, 0.7, 0.95])
"""shares of missing readings of a loose wire, equally probable"""
PRIOR = np.array([300.0, 0.5, 4.0, 1.0])
"""readings after a reading, missing ones of them, readings after a missing one, and missing ones of them"""
NOTHING, LARGEST = -30.0, 60.0
"""limits of the log of the statistic"""
LEAST_RATIO, LARGEST_SHARE = 2.0, 0.9
"""a loose wire loses at least so many times what a healthy line loses"""


class MissingReadings:
    """Shiryaev-Roberts again: a healthy line loses a share of readings and another of those after a missing one."""

    def __init__(self, fans: int, log_limit: float) -> None:
        """Begin without a reading. log_limit: of the statistic."""
        self._log_limit = log_limit
        self._counts = PRIOR.copy()
        self._log_terms = np.full((fans, len(SHARES)), NOTHING)
        self._returned = np.zeros(fans)
        self.is_active = np.zeros(fans, np.bool_)

    def take(self, missing: Array) -> None:
        """The counts of a bin, (fans, 4), as in `Bin.missing`."""
        gain = self._gain(missing)
        moved = np.minimum(np.logaddexp(self._log_terms, 0.0) + gain, LARGEST)
        self._log_terms = np.where(self.is_active[:, np.newaxis], self._log_terms, moved)
        likeliest = self._log_terms.argmax(axis=1)[:, np.newaxis]
        back = self._returned - np.take_along_axis(gain, likeliest, axis=1)[:, 0]
        self._returned = np.where(self.is_active, np.maximum(back, 0.0), 0.0)
        log_statistic = np.logaddexp.reduce(self._log_terms, axis=1) - np.log(len(SHARES))
        cleared = self.is_active & (self._returned > self._log_limit)
        self.is_active = (self.is_active | (log_statistic > self._log_limit)) & ~cleared
        self._log_terms[cleared] = NOTHING
        self._counts = self._counts + missing[~self.is_active].sum(axis=0)

    def _gain(self, missing: Array) -> Array:
        """(fans, SHARES) log of how much likelier the counts are of a loose wire than of a healthy line."""
        after_reading, lost, after_missing, lost_again = missing.T[:, :, np.newaxis]
        readings, lost_ones, missing_ones, lost_again_ones = self._counts
        first, again = lost_ones / readings, lost_again_ones / missing_ones
        shares = np.maximum(SHARES, min(LEAST_RATIO * first, LARGEST_SHARE))
        found: Array = (
            lost * np.log(shares / first)
            + (after_reading - lost) * np.log((1.0 - shares) / (1.0 - first))
            + lost_again * np.log(shares / again)
            + (after_missing - lost_again) * np.log((1.0 - shares) / (1.0 - again))
        )
        return found
