"""What the fans of a tray have in common: the air of the room and the supply shift all of them, and none is faulty.

The part that the offsets of most fans have in common, as a share of the speed, is subtracted from every residual. It
moves no further than to the nearer of the two offsets in the middle: of three fans to their median, of two or four only
if it lies outside of the (inner) two. So one fan that is off by itself does not take it along. It is limited
(HealthyResidual.shared_limit): more than weather is left in the residual of every fan.

Until the first fan has its baseline, offsets are residuals as they are, and the shared one follows their mean at once:
baselines are then found without it. A baseline that took a share of the speed as its own would be wrong at all other
speeds.

While only one of the fans turns it cannot be compared. Then the shared offset takes the place of the fan's own
baseline, as slow and with as short a reach: otherwise both would have followed the same weather when the others turn
again.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from schemas.messages import Array
from scoring.baseline.intervals import Intervals, first_end
from scoring.detectors.state import ColumnState

SMOOTHING_S = 8.0  # longer than a tacho counts, shorter than supply and air take to change by much
LEAST_FANS = 2
MIN_VALID_SHARE = 0.5  # of an interval's samples
LARGEST_SIGMAS = 1e3  # larger offsets are clipped to this
FIXED_POINT_ONE = 1 << 6  # integer sums do not depend on how samples are cut


class SharedOverIntervals(NamedTuple):
    """What fans share in successive intervals."""

    values: Array
    """(intervals,) the offset for each rad/s, in each"""
    compared: Array
    """(intervals,) the one when fans were last compared"""
    products: Array
    squares: Array
    counts: Array
    """(intervals, fans) the sums of each; in the first with those before"""
    ends: int
    """so many of the intervals these hold for"""


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

        Offsets at low speed are drawn towards zero, or what was shared when all fans were commissioned again (ridge
        regression): errors of the twin there, as large as half of its residual, must not become large offsets at high
        speed. `limit` is two standard deviations of the shared one.
        """
        self._limit = limit
        self._ridge = (residual_std / limit) ** 2
        self._gain, self._gain_alone = (-np.expm1(-interval_s / time_s) for time_s in (SMOOTHING_S, adaptation_s))
        self._reach_sigmas = reach_sigmas
        self._value = np.zeros(1)
        self._compared = np.zeros(1)
        """the value when fans were last compared"""
        self._commissioned = np.zeros(1)
        """the value when fans had their baselines, or all were commissioned again; the limit is from there"""
        self._first = np.zeros(1, np.int64)
        """intervals in which fans were compared before any of them had a baseline"""
        self._products = np.zeros(fans, np.int64)
        self._squares = np.zeros(fans, np.int64)
        self._counts = np.zeros(fans, np.int64)

    @property
    def since_commissioning(self) -> float:
        """How far the offset was from that of the last commissioning of all fans when fans were last compared, for each
        rad/s, in the unit of the residual: what only one fan that turned alone has added since is not shared.
        """
        return float(self._compared[0] - self._commissioned[0])

    @property
    def is_known(self) -> bool:
        """Whether fans were compared before any of them had a baseline."""
        return bool(self._first[0])

    @property
    def independent_intervals(self) -> float:
        """The number of independent intervals of a fan whose mean would vary as much."""
        return (2.0 / self._gain - 1.0) * len(self._counts)

    def over(
        self,
        offset: Array,
        speed_sigmas: Array,
        valid: Array,
        intervals: Intervals,
        commissioned: Array,
        moving: Array | None,
    ) -> SharedOverIntervals:
        """What is shared in the present interval and later ones, if each but the last ends as `end_interval` ends it.

        offset: (n, fans) from the commissioned baseline, sigma. speed_sigmas: (n, fans) the speed over sigma, with its
        sign. commissioned: (fans,). moving: (intervals, fans); None: no fan. See `end_interval`.
        """
        known = np.where(valid, offset, 0.0).clip(-LARGEST_SIGMAS, LARGEST_SIGMAS)
        speed = np.where(valid, speed_sigmas, 0.0)
        sums = np.array((known * speed, speed * speed)).swapaxes(0, 1)
        products, squares = intervals.sums(np.rint(sums * FIXED_POINT_ONE).astype(np.int64)).swapaxes(0, 1)
        counts = intervals.sums(valid.astype(np.int64))
        products[0] += self._products
        squares[0] += self._squares
        counts[0] += self._counts
        values, compared, ends = self._values(products, squares, counts, intervals.expected, commissioned, moving)
        return SharedOverIntervals(values, compared, products, squares, counts, ends)

    def _values(
        self,
        products: Array,
        squares: Array,
        counts: Array,
        expected: int,
        commissioned: Array,
        moving: Array | None,
    ) -> tuple[Array, Array, int]:
        """(intervals,) the value in each, and the one when fans were last compared; and up to which these hold: until
        the end of the first interval in which a fan turned alone, itself counted."""
        if len(counts) == 1:
            return self._value.copy(), self._compared.copy(), 1
        known = (counts >= MIN_VALID_SHARE * expected) & (squares > 0)
        if moving is not None:
            known &= ~moving
        number = known.sum(axis=1)
        is_compared = number >= LEAST_FANS
        alone = (number > 0) & ~is_compared & (commissioned.sum() >= LEAST_FANS)
        ridge = self._ridge * FIXED_POINT_ONE * counts
        divisor = np.where(known, squares + ridge, 1.0)
        offsets = np.sort(np.where(known, self._towards_commissioned(products, ridge) / divisor, np.inf), axis=1)
        each, middle = np.arange(len(counts)), np.maximum(number - 1, 0) // 2
        low, high = offsets[each, middle].tolist(), offsets[each, np.maximum(number - 1, 0) - middle].tolist()
        value, last_compared = float(self._value[0]), float(self._compared[0])
        least, most = self._range
        values, compared = np.empty((2, len(counts)))
        for k, compares in enumerate(is_compared.tolist()):
            values[k], compared[k] = value, last_compared
            if compares:
                value += self._gain * (min(max(value, low[k]), high[k]) - value)
                value = last_compared = min(max(value, least), most)
        return values, compared, first_end(alone)

    def take(self, of: SharedOverIntervals) -> None:
        """Go on in the last of some intervals."""
        self._value[:], self._compared[:] = of.values[-1], of.compared[-1]
        self._products[:], self._squares[:], self._counts[:] = of.products[-1], of.squares[-1], of.counts[-1]

    def end_interval(
        self, samples: int, commissioned: Array, learns: Array, moving: Array | None, *, at_first: bool
    ) -> Array:
        """End the present interval of so many samples. at_first: no fan has a baseline yet, and offsets are residuals.

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
        if at_first and is_compared:
            self._first += 1
            gain = max(gain, 1.0 / float(self._first[0]))
        if used.any():
            ridge = self._ridge * FIXED_POINT_ONE * self._counts[used]
            products = self._towards_commissioned(self._products[used], ridge)
            offsets = np.sort(products / (self._squares[used] + ridge))
            middle = (len(offsets) - 1) // 2
            self._value += gain * (self._value.clip(offsets[middle], offsets[-1 - middle]) - self._value)
            self._value[:] = self._value.clip(*self._range)
            if is_compared:
                self._compared[:] = self._value
            else:
                speed_sigmas = np.sqrt(self._squares[used] / (self._counts[used] * FIXED_POINT_ONE))
                reach = self._reach_sigmas / speed_sigmas
                self._value[:] = self._value.clip(self._compared - reach, self._compared + reach)
        self._products[:] = self._squares[:] = self._counts[:] = 0
        return alone

    def begin_from_here(self) -> None:
        """The first fan has its baseline, found without what is shared now."""
        self._commissioned[:], self._first[:] = self._value, 0

    def restart(self, fans: Array, *, keeps_value: bool) -> None:
        """Some fans, (fans,) of bool, are commissioned again.

        keeps_value: also where these are all fans. What they share is a share of the speed; baselines that are learned
        without it take it as an offset, which is wrong at all other speeds.
        """
        self._products[fans] = self._squares[fans] = self._counts[fans] = 0
        if not fans.all():
            return
        if not keeps_value:
            self._value[:] = self._compared[:] = 0.0
        self._commissioned[:] = self._compared[:] = self._value
        self._first[:] = 0

    def restore(self, state: Mapping[str, Any]) -> None:
        """See ColumnState. Earlier snapshots do not say what was shared when fans were commissioned, or at first."""
        super().restore({"commissioned": [0.0], "first": [0], **state})

    def _towards_commissioned(self, products: Array, ridge: Array) -> Array:
        """The products, such that the ridge draws towards the value at the last commissioning of all fans, or zero."""
        commissioned = float(self._commissioned[0])
        return products + commissioned * ridge if commissioned else products

    @property
    def _range(self) -> tuple[float, float]:
        commissioned = float(self._commissioned[0])
        return commissioned - self._limit, commissioned + self._limit

    def columns(self) -> dict[str, Array]:
        """See ColumnState."""
        return {
            "value": self._value,
            "compared": self._compared,
            "commissioned": self._commissioned,
            "first": self._first,
            "products": self._products,
            "squares": self._squares,
            "counts": self._counts,
        }
