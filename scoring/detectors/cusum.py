"""Two-sided CUSUM: detects a shift that stays, in a time inversely proportional to its size.

Page, Biometrika 41 (1954) 100. C+ = max(0, C+ + (z - k) dt), and C- the same of -z, in sigma seconds. z is the
standardised residual, k the reference value: half the shift to be detected. The sums are integers (fixed point), which
add without rounding: a block gives the same bits as its samples one by one. They end at a cap; without it a long fault
would take as long again to decay.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from schemas.messages import Array

ONE = 1 << 24  # fixed-point value of one sigma second
LARGEST_SIGMAS = 1e4  # larger residuals are clipped to this
UNCAPPED = 1 << 62
BOTH_SIDES = np.array([[1.0], [-1.0]])


class Cusum:
    """The sums of a tray's fans, with one reference value or several."""

    def __init__(self, fans: int, references: Sequence[float], caps: Sequence[float]) -> None:
        """references: sigma. caps: of each, sigma seconds; may be infinite."""
        self._references = np.array(references)[:, np.newaxis, np.newaxis]
        of_each = [round(cap * ONE) if np.isfinite(cap) else UNCAPPED for cap in caps]
        self._caps = np.array(of_each, np.int64)[:, np.newaxis, np.newaxis]
        self.sums = np.zeros((len(references), 2, fans), np.int64)
        """(references, 2, fans) C+ and C-, in fixed point"""

    def reset(self, fans: Array) -> None:
        """Start again for some fans, (fans,) of bool."""
        self.sums[..., fans] = 0

    def update(self, z: Array, valid: Array, period_s: float) -> Array:
        """Take a block, (n, fans) each; invalid samples leave the sums as they are.

        Returns (n, references, fans) of max(C+, C-).
        """
        shift = np.where(valid, z, 0.0).clip(-LARGEST_SIGMAS, LARGEST_SIGMAS)[:, np.newaxis, np.newaxis]
        gains = np.rint((shift * BOTH_SIDES - self._references) * (period_s * ONE)).astype(np.int64)
        gains *= valid[:, np.newaxis, np.newaxis]
        sums = bounded_sums(gains, self.sums, self._caps)
        self.sums[...] = sums[-1]
        return sums.max(axis=2) / ONE


def bounded_sums(gains: Array, before: Array, cap: Array | int) -> Array:
    """(n, ...) each sum after each sample, not below zero and not above its cap; all integers.

    gains: (n, ...). before: (...), the sums before the first sample. cap: one for all, or of a shape like `before`.
    """
    totals = before + gains.cumsum(axis=0)
    sums = totals - np.minimum(np.minimum.accumulate(totals, axis=0), 0)
    beyond = sums > cap
    if np.count_nonzero(beyond):
        caps = np.broadcast_to(cap, before.shape)
        for place in np.argwhere(beyond.any(axis=0)).tolist():
            at = tuple(place)
            sums[:, *at] = _capped(gains[:, *at], int(before[at]), int(caps[at]))
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
