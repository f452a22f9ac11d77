"""Two-sided CUSUM: finds a shift that lasts, however small, in time inversely proportional to its size.

Page, Biometrika 41 (1954) 100. C+ = max(0, C+ + (z - k) dt) and C- likewise of -z, in sigma seconds, with z the
standardised residual and k the reference value: half the shift that is to be found. The sums are kept in fixed point:
integers add without rounding, so that a block may be summed at once and still gives what sample by sample gives.
They end at a cap, so that a long fault does not take as long again to be forgotten.
"""

from __future__ import annotations

import numpy as np

from schemas.messages import Array

ONE = 1 << 24  # of fixed point: one sigma second
LARGEST = 1e4  # sigma; a larger residual counts as this


class Cusum:
    """Of a tray's fans."""

    def __init__(self, fans: int, reference: float, cap: float) -> None:
        """reference: sigma. cap: sigma seconds, may be infinite."""
        self._reference = reference
        self._cap = round(cap * ONE) if np.isfinite(cap) else None
        self.sums = np.zeros((2, fans), np.int64)
        """(2, fans) C+ and C-, in fixed point"""

    def uncap(self) -> None:
        """Let the sums grow without end."""
        self._cap = None

    def reset(self, fans: Array) -> None:
        """Begin anew for some fans, (fans,) of bool."""
        self.sums[:, fans] = 0

    def update(self, z: Array, valid: Array, step_s: float) -> Array:
        """Take a block, (n, fans) each; samples that are not valid leave the sums alone. Returns max(C+, C-)."""
        shift = np.clip(np.where(valid, z, 0.0), -LARGEST, LARGEST)
        gains = np.stack((shift - self._reference, -shift - self._reference)) * (step_s * ONE)
        gains = np.where(valid, np.rint(gains), 0.0).astype(np.int64)  # (2, n, fans)
        totals = self.sums[:, np.newaxis] + np.cumsum(gains, axis=1)
        sums = totals - np.minimum(np.minimum.accumulate(totals, axis=1), 0)
        if self._cap is not None:
            for side, fan in np.argwhere((sums > self._cap).any(axis=1)).tolist():
                self._sum_to_the_cap(sums[side, :, fan], gains[side, :, fan], int(self.sums[side, fan]))
        self.sums = sums[:, -1].copy()
        return sums.max(axis=0) / ONE

    def _sum_to_the_cap(self, sums: Array, gains: Array, total: int) -> None:
        assert self._cap is not None
        for row, gain in enumerate(gains.tolist()):
            total = min(max(total + gain, 0), self._cap)
            sums[row] = total
