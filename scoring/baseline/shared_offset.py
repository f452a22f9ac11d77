"""What the fans of a tray have in common: the air of the room and the supply shift all of them, and none is faulty.

The part that the offsets of most fans have in common, as a share of the speed, is subtracted from every residual. It
moves no further than to the nearer of the two offsets in the middle: of three fans to their median, of two or four only
if it lies outside of the (inner) two. So one fan that is off by itself does not take it along. It is limited
(HealthyResidual.shared_limit): more than weather is left in the residual of every fan.

While only one of the fans turns it cannot be compared. Then the shared offset takes the place of the fan's own
baseline, as slow and with as short a reach: otherwise both would have followed the same weather when the others turn
again.
"""

from __future__ import annotations

import numpy as np

from schemas.messages import Array
from scoring.detectors.state import ColumnState

SMOOTHING_S = 8.0  # longer than a tacho counts, shorter than supply and air take to change by much
LEAST_FANS = 2
MIN_VALID_SHARE = 0.5  # of an interval's samples
LARGEST_SIGMAS = 1e3  # larger offsets are clipped to this
FIXED_POINT_ONE = 1 << 6  # integer sums do not depend on how samples are cut


class SharedOffset(ColumnState):
    """The offset that the fans of a tray share, of one residual, for each rad/s of their speed."""

    def __init__(
        self,
        fans: int,
        *,
        limit: float,
        residual_std: float,
        interval_s: float,
        adaptation_s: float,
        reach_sigmas: float,
    ) -> None:
        """limit: of the offset, for each rad/s. residual_std: of the healthy residual, sigma. interval_s: length of an
        interval. adaptation_s, reach_sigmas: how slowly, and how far, the baseline of a fan may move.

        Offsets at low speed are drawn towards zero (ridge regression): errors of the twin there, as large as half of
        its residual, must not become large offsets at high speed. `limit` is two standard deviations of the shared one.
        """
        self._limit = limit
        self._ridge = (residual_std / limit) ** 2
        self._gain, self._gain_alone = (-np.expm1(-interval_s / time_s) for time_s in (SMOOTHING_S, adaptation_s))
        self._reach_sigmas = reach_sigmas
        self._value = np.zeros(1)
        self._compared = np.zeros(1)
        """the value when fans were last compared"""
        self._products = np.zeros(fans, np.int64)
        self._squares = np.zeros(fans, np.int64)
        self._counts = np.zeros(fans, np.int64)

    @property
    def compared(self) -> float:
        """The offset when fans were last compared, for each rad/s, in the unit of the residual: what only one fan that
        turned alone has added since is not shared.
        """
        return float(self._compared[0])

    @property
    def independent_intervals(self) -> float:
        """The number of independent intervals of a fan whose mean would vary as much."""
        return (2.0 / self._gain - 1.0) * len(self._counts)

    def at(self, speed_sigmas: Array) -> Array:
        """(n, fans) the offset, sigma. speed_sigmas: (n, fans) the speed over sigma, with its sign."""
        return self._value * speed_sigmas

    def add(self, offset: Array, speed_sigmas: Array, valid: Array) -> None:
        """Take samples of the present interval, (n, fans) each; offset: from the commissioned baseline, sigma."""
        known = np.where(valid, offset, 0.0).clip(-LARGEST_SIGMAS, LARGEST_SIGMAS)
        speed = np.where(valid, speed_sigmas, 0.0)
        self._products += np.rint(known * speed * FIXED_POINT_ONE).astype(np.int64).sum(axis=0)
        self._squares += np.rint(speed * speed * FIXED_POINT_ONE).astype(np.int64).sum(axis=0)
        self._counts += valid.sum(axis=0)

    def end_interval(self, samples: int, commissioned: Array, learns: Array, moving: Array | None) -> Array:
        """End the present interval of so many samples.

        commissioned: (fans,) which fans have a baseline to be measured against. learns: (fans,) whether a fan's
        baseline may learn from the interval. moving: (fans,) whether the fan moved; None: no fan.

        Returns (fans,) which fan turned alone, so that its baseline is to learn nothing.
        """
        known = (self._counts >= MIN_VALID_SHARE * samples) & (self._squares > 0)
        if moving is not None:
            known &= ~moving
        is_compared = known.sum() >= LEAST_FANS
        alone = known & (not is_compared) & (commissioned.sum() >= LEAST_FANS)
        used, gain = (known, self._gain) if is_compared else (alone & learns, self._gain_alone)
        if used.any():
            ridge = self._ridge * FIXED_POINT_ONE * self._counts[used]
            offsets = np.sort(self._products[used] / (self._squares[used] + ridge))
            middle = (len(offsets) - 1) // 2
            self._value += gain * (self._value.clip(offsets[middle], offsets[-1 - middle]) - self._value)
            self._value[:] = self._value.clip(-self._limit, self._limit)
            if is_compared:
                self._compared[:] = self._value
            else:
                speed_sigmas = np.sqrt(self._squares[used] / (self._counts[used] * FIXED_POINT_ONE))
                reach = self._reach_sigmas / speed_sigmas
                self._value[:] = self._value.clip(self._compared - reach, self._compared + reach)
        self._products[:] = self._squares[:] = self._counts[:] = 0
        return alone

    def restart(self, fans: Array) -> None:
        """Some fans, (fans,) of bool, are commissioned again; all of them: then nothing is shared yet."""
        self._products[fans] = self._squares[fans] = self._counts[fans] = 0
        if fans.all():
            self._value[:] = self._compared[:] = 0.0

    def columns(self) -> dict[str, Array]:
        """See ColumnState."""
        return {
            "value": self._value,
            "compared": self._compared,
            "products": self._products,
            "squares": self._squares,
            "counts": self._counts,
        }
