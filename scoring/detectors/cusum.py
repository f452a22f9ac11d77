"""Two-sided CUSUM: detects a shift that stays, in a time inversely proportional to its size.

Page, Biometrika 41 (1954) 100. C+ = max(0, C+ + (z - k) dt), and C- the same of -z, in sigma seconds. z is the
standardised residual, k the reference value: half the shift to be detected. The sums are integers (fixed point), which
add without rounding: a block gives the same bits as its samples one by one. They end at a cap; without it a long fault
would take as long again to decay.
"""

from __future__ import annotations

import numpy as np

from schemas.messages import Array

ONE = 1 << 24  # fixed-point value of one sigma second
LARGEST_SIGMAS = 1e4  # larger residuals are clipped to this
BOTH_SIDES = np.array([[1.0], [-1.0]])


class Cusum:
    """The sums of a tray's fans."""

    def __init__(self, fans: int, reference: float, cap: float) -> None:
        """reference: sigma. cap: sigma seconds; may be infinite."""
        self._reference = reference
        self._cap = round(cap * ONE) if np.isfinite(cap) else None
        self.sums = np.zeros((2, fans), np.int64)
        """(2, fans) C+ and C-, in fixed point"""

    def reset(self, fans: Array) -> None:
        """Start again for some fans, (fans,) of bool."""
        self.sums[:, fans] = 0

    def update(self, z: Array, valid: Array, period_s: float) -> Array:
        """Take a block, (n, fans) each; invalid samples leave the sums as they are. Returns max(C+, C-)."""
        shift = np.where(valid, z, 0.0).clip(-LARGEST_SIGMAS, LARGEST_SIGMAS)
        gains = (shift[:, np.newaxis] * BOTH_SIDES - self._reference) * (period_s * ONE)  # (n, 2, fans)
        gains = np.where(valid[:, np.newaxis], np.rint(gains), 0.0).astype(np.int64)
        sums = bounded_sums(gains.reshape(len(z), -1), self.sums.ravel(), self._cap).reshape(gains.shape)
        self.sums = sums[-1].copy()
        return sums.max(axis=1) / ONE


def bounded_sums(gains: Array, before: Array, cap: int | None) -> Array:
    """(n, fans) the sum after each sample, not below zero and not above the cap; all integers.

    gains: (n, fans). before: (fans,) the sums before the first. cap: None for none.
    """
    totals = before + gains.cumsum(axis=0)
    sums = totals - np.minimum(np.minimum.accumulate(totals, axis=0), 0)
    if cap is not None and (sums > cap).any():
        for fan in np.flatnonzero((sums > cap).any(axis=0)).tolist():
            sums[:, fan] = _capped(gains[:, fan], int(before[fan]), cap)
    return sums


def _capped(gains: Array, total: int, cap: int) -> list[int]:
    sums = []
    for gain in gains.tolist():
        total += gain
        if total < 0:
            total = 0
        elif total > cap:
            total = cap
        sums.append(total)
    return sums
