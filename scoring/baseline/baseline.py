"""Baseline of a residual: its offset that is specific to the fan or the day and is not a fault.

The time since the first sample of a session is cut into intervals. The mean residual of the first steady interval is
the first baseline. A fan that starts from rest has no steady residual yet; after a number of unsteady intervals the
next one is accepted. On a slow line an interval has too few samples to show whether it is steady: there the first
baseline is from an interval in which the fan did not move, and not from the very first, in which that is not known.
During commissioning the baseline is the median of the means of its intervals. Later intervals refine it, as a running
mean first and with a fixed time constant in the long run.

Nothing is learned from an anomaly. While commissioning, an interval counts if no statistic exceeded its limit; later,
if none exceeded half of it. The commissioned baseline is limited to the offsets of healthy fans, and the later one to
a distance from the commissioned one: slow wear reaches that distance, the residual grows, and an alarm is raised.

The offset may change with the speed (scoring.baseline.speed_scaling). The mean of an interval is then a least-squares
estimate of the offset at the reference speed, and its information is the mean square of the scaling in it. An error of
the twin at low speed must not be extrapolated to a large offset at high speed, so estimates are shrunk towards zero
(ridge regression). Above the scaling at which most was learned, the offset is uncertain in proportion
(`offset_uncertainty`). There the baseline adapts faster, and the commissioned one moves with it by at most that
uncertainty.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from schemas.messages import Array
from scoring.baseline.intervals import Intervals, first_end
from scoring.baseline.settings import BaselineSettings
from scoring.column_state import ColumnState

COMMISSIONING_INTERVALS = 10
MIN_VALID_SHARE = 0.5  # of an interval's samples
FIXED_POINT_ONE = 1 << 20  # one sigma, or one sigma squared; integer sums do not depend on how samples are cut
LARGEST_SIGMAS = 1e3  # larger residuals are clipped to this
MAX_STEADY_STD = 2.0  # standard deviation relative to a healthy one: an interval with more is not steady
MIN_STEADY_READINGS = 5  # of an interval: fewer do not show that it is steady
MAX_UNSTEADY_INTERVALS = 10  # intervals without a steady one, after which an unsteady one is accepted
ROUNDING = 1e-9
OFFSET_RANGE_RMS = 3.0  # an offset may be so many times the root mean square of healthy ones
FASTER_INFORMATION = 1.5  # times the least information kept: the baseline adapts faster to such an interval
MIN_INFORMATION = 1e-12


class BaselineState(NamedTuple):
    """Baselines in successive intervals, (intervals, fans) each; see Baseline."""

    value: Array
    commissioned: Array
    intervals: Array
    total_information: Array
    learned_scale: Array

    @property
    def is_set(self) -> Array:
        """Whether a fan has a baseline, so that its residual can be scored."""
        return self.intervals > 0

    @property
    def is_commissioning(self) -> Array:
        """Whether commissioning goes on."""
        return self.intervals < COMMISSIONING_INTERVALS


class IntervalSums(NamedTuple):
    """Of the samples of some intervals."""

    products: Array
    """(3, intervals, fans) of the residual times the scaling, and of the squares of both; in fixed point"""
    counts: Array
    """(intervals, fans) of valid samples"""


class Baseline(ColumnState):
    """The baselines of one residual of a tray's fans at the reference speed, in sigma of each fan."""

    def __init__(
        self, fans: int, settings: BaselineSettings, adaptation_intervals: float, residual_std: float = 1.0
    ) -> None:
        """adaptation_intervals: time constant in the long run. residual_std: of the healthy residual, sigma."""
        self._settings = settings
        self._adaptation_intervals = adaptation_intervals
        self._residual_std = residual_std
        self.value = np.zeros(fans)
        """(fans,) sigma; zero before the first good interval"""
        self.commissioned = np.zeros(fans)
        """(fans,) sigma: the value at the end of commissioning, or so far"""
        self.intervals = np.zeros(fans, np.int64)
        """(fans,) good intervals so far"""
        self.unsteady_intervals = np.zeros(fans, np.int64)
        """(fans,) unsteady intervals before the first good one"""
        self.interval_means = np.full((COMMISSIONING_INTERVALS, fans), np.nan)
        """sigma, of the good intervals with the most information"""
        self.interval_information = np.zeros((COMMISSIONING_INTERVALS, fans))
        """mean square of the scaling in each of these intervals"""
        self.total_information = np.zeros(fans)
        """(fans,) of all good intervals, each counted as one at most"""
        self.learned_scale = np.zeros(fans)
        """(fans,) weighted root-mean-square scaling of the intervals that are kept"""
        self._sums = np.zeros((3, fans), np.int64)
        """over the present interval, of the residual times the scaling, and of the squares of both; in fixed point"""
        self._counts = np.zeros(fans, np.int64)

    @property
    def is_set(self) -> Array:
        """(fans,) whether a fan has a baseline, so that its residual can be scored."""
        return self.intervals > 0

    @property
    def is_commissioning(self) -> Array:
        """(fans,) whether commissioning goes on."""
        return self.intervals < COMMISSIONING_INTERVALS

    @property
    def is_learning_first(self) -> bool:
        """Whether commissioning may go on with the present interval, of any fan."""
        return bool((self.is_commissioning & (self._counts > 0)).any())

    @property
    def state(self) -> BaselineState:
        """(1, fans) of the present interval."""
        columns = (self.value, self.commissioned, self.intervals, self.total_information, self.learned_scale)
        return BaselineState(*(column[np.newaxis].copy() for column in columns))

    @property
    def is_at_limit(self) -> Array:
        """(fans,) whether the baseline is held at the adaptation limit."""
        return self.at_limit(self.state)[0]

    def at_limit(self, state: BaselineState) -> Array:
        """The same of a state."""
        limit = self._settings.adaptation_limit_sigmas
        moved = np.abs(state.value - state.commissioned)
        return state.is_set & (moved >= limit * (1.0 - ROUNDING)) & (limit > 0)

    def independent_intervals(self, state: BaselineState) -> Array:
        """The number of independent intervals whose mean would vary as much as the baseline."""
        in_the_long_run = 2.0 * self._adaptation_intervals - 1.0
        return np.minimum(state.total_information, in_the_long_run)

    def offset_uncertainty(self, scaling: Array, learned_scale: Array) -> Array:
        """(n, fans) how far the fan's offset at a scaling (n, fans) may be from the scaled baseline, sigma.

        learned_scale: (fans,) of the baseline, now or in an earlier interval.
        """
        return OFFSET_RANGE_RMS * self._settings.rms_sigmas * np.maximum(scaling - learned_scale, 0.0)

    def restart(self, fans: Array) -> None:
        """Commission some fans again, (fans,) of bool."""
        for column in self.columns().values():
            column[..., fans] = 0
        self.interval_means[:, fans] = np.nan
        self._find_learned_scale()

    def sums(self, residual: Array, valid: Array, scaling: Array, intervals: Intervals) -> IntervalSums:
        """Of samples (n, fans) of the present interval and later ones; residual in sigma, scaling finite."""
        known = np.where(valid, residual, 0.0).clip(-LARGEST_SIGMAS, LARGEST_SIGMAS)
        products = np.array((known * scaling, np.where(valid, scaling * scaling, 0.0), known * known))
        of_each = intervals.sums(np.rint(products.swapaxes(0, 1) * FIXED_POINT_ONE).astype(np.int64)).swapaxes(0, 1)
        counts = intervals.sums(valid.astype(np.int64))
        of_each[:, 0] += self._sums
        counts[0] += self._counts
        return IntervalSums(of_each, counts)

    def only_refined(self, valid: Array) -> bool:
        """Whether intervals with these valid samples (n, fans) of bool only refine baselines that are commissioned."""
        nothing = ~valid.any(axis=0) & (self._counts == 0)
        return bool(((self.intervals >= COMMISSIONING_INTERVALS) | nothing).all())

    def refined_up_to(self, sums: IntervalSums, expected: int) -> int:
        """How many intervals come before the end of the first one to which a baseline adapts faster, itself counted."""
        _, information, _ = sums.products / np.maximum(sums.counts, 1) / FIXED_POINT_ONE
        faster = self._seen(sums.counts, expected) & (
            information > FASTER_INFORMATION * self.interval_information.min(axis=0)
        )
        return first_end(faster.any(axis=1))

    def refined(self, sums: IntervalSums, expected: int, below_half_limit: Array) -> BaselineState:
        """(intervals, fans) the baselines in each interval, if each but the last ends as `end_interval` ends it.

        Only where `only_refined`, and for `refined_up_to` intervals. below_half_limit: (intervals, fans).
        """
        product, information, _ = sums.products / np.maximum(sums.counts, 1) / FIXED_POINT_ONE
        mean = product / np.maximum(information + self._settings.ridge, MIN_INFORMATION)
        good = self._seen(sums.counts, expected) & below_half_limit
        counted = np.minimum(information, 1.0)
        learned = np.where(good, counted, 0.0)
        total = np.add.accumulate(np.concatenate((self.total_information[np.newaxis], learned)), axis=0)
        gain = counted / np.maximum(np.minimum(total[1:], self._adaptation_intervals), MIN_INFORMATION)
        limit = self._settings.adaptation_limit_sigmas
        commissioned = np.repeat(self.commissioned[np.newaxis], len(mean), axis=0)
        commissioned[1:] += 0.0  # no -0.0 after `end_interval`
        low, high = commissioned[-1] - limit, commissioned[-1] + limit
        values, value = np.empty(mean.shape), self.value
        for k in range(len(values)):
            values[k] = value
            value = np.where(good[k], value + gain[k] * (mean[k] - value), value).clip(low, high)
        before = np.concatenate((np.zeros((1, len(value)), np.int64), good[:-1].cumsum(axis=0)))
        same = (len(values), len(value))
        return BaselineState(
            values,
            commissioned,
            self.intervals + before,
            total[:-1],
            np.broadcast_to(self.learned_scale, same),
        )

    def take(self, state: BaselineState, sums: IntervalSums) -> None:
        """Go on in the last of some intervals; state: of each, sums: with those before them in the first."""
        if len(state.value) > 1:
            self.value, self.commissioned = state.value[-1].copy(), state.commissioned[-1].copy()
            self.intervals[:], self.total_information[:] = state.intervals[-1], state.total_information[-1]
        self._sums[:], self._counts[:] = sums.products[:, -1], sums.counts[-1]

    @staticmethod
    def _seen(counts: Array, expected: int) -> Array:
        """Whether there are enough samples in an interval."""
        return counts >= max(MIN_VALID_SHARE * expected, 1)

    def end_interval(
        self,
        samples: int,
        within_limit: Array,
        below_half_limit: Array,
        moving: Array,
        few_readings: Array,
    ) -> None:
        """End the present interval of so many samples.

        within_limit, below_half_limit: (fans,) whether every statistic stayed there during the interval. moving:
        (fans,) whether the fan moved, so that only its first baseline may come from the interval
        (scoring.baseline.movement). few_readings: (fans,) whether an interval has too few readings to show that it is
        steady. Such a fan gets its first baseline only from an interval in which it does not move: a baseline of a fan
        that speeds up would raise an alarm that never clears.
        """
        counts, is_set, commissioning = np.maximum(self._counts, 1), self.is_set, self.is_commissioning
        product, information, square = self._sums / counts / FIXED_POINT_ONE
        mean = product / np.maximum(information + self._settings.ridge, MIN_INFORMATION)
        seen = self._seen(self._counts, samples)
        good = seen & np.where(commissioning, within_limit, below_half_limit)
        if not is_set.all():
            explained = product * product / np.maximum(information, MIN_INFORMATION)
            deviation = np.sqrt(np.maximum(square - explained, 0.0))
            unsteady = seen & ~is_set & (deviation > MAX_STEADY_STD * self._residual_std)
            unsteady |= few_readings & seen & ~is_set & (moving | (self.unsteady_intervals == 0))
            unsteady &= self.unsteady_intervals < MAX_UNSTEADY_INTERVALS
            self.unsteady_intervals += unsteady
            good &= ~unsteady
        good &= ~(moving & commissioning & is_set)
        self._learn(mean, information, good)
        self.intervals += good
        self._sums[:] = self._counts[:] = 0

    def _learn(self, mean: Array, information: Array, good: Array) -> None:
        """Move the baselines of fans with a good interval. All (fans,)."""
        settings = self._settings
        commissioning = good & self.is_commissioning
        faster = good & ~commissioning & (information > FASTER_INFORMATION * self.interval_information.min(axis=0))
        counted = np.minimum(information, 1.0)
        self.total_information += np.where(good, counted, 0.0)
        gain = counted / np.maximum(np.minimum(self.total_information, self._adaptation_intervals), MIN_INFORMATION)
        moved: Array | float = 0.0
        kept = commissioning | faster
        if kept.any():
            scale_before = self.learned_scale
            self._keep(mean, information, kept)
            weight = np.maximum(np.square(self.interval_information).sum(axis=0), MIN_INFORMATION)
            gain = np.where(faster, np.maximum(gain, np.square(information) / weight), gain)
            learned = np.maximum(self.learned_scale - scale_before, 0.0)
            moved = np.where(faster, OFFSET_RANGE_RMS * settings.rms_sigmas * learned, 0.0)
        value = np.where(good, self.value + gain * (mean - self.value), self.value)
        if commissioning.any():
            weights = np.square(self.interval_information[:, commissioning])
            median = _weighted_median(self.interval_means[:, commissioning], weights)
            limit = settings.commissioning_limit_sigmas
            value[commissioning] = np.clip(median, -limit, limit)
        commissioned = value.clip(self.commissioned - moved, self.commissioned + moved)
        limit = settings.adaptation_limit_sigmas
        held = value.clip(commissioned - limit, commissioned + limit)
        self.value = np.where(commissioning, value, held)
        self.commissioned = np.where(commissioning, self.value, commissioned)

    def _keep(self, mean: Array, information: Array, fans: Array) -> None:
        """Keep the means of some fans, each in place of the one with the least information."""
        least, each = self.interval_information.argmin(axis=0), np.flatnonzero(fans)
        self.interval_means[least[each], each] = mean[each]
        self.interval_information[least[each], each] = information[each]
        self._find_learned_scale()

    def _find_learned_scale(self) -> None:
        weights = np.square(self.interval_information)
        total = np.maximum(weights.sum(axis=0), MIN_INFORMATION)
        self.learned_scale = np.sqrt((weights * self.interval_information).sum(axis=0) / total)

    def restore(self, state: Mapping[str, Any]) -> None:
        """See ColumnState."""
        super().restore(state)
        self._find_learned_scale()

    def arrays(self) -> dict[str, Array]:
        """See ColumnState."""
        return {**self.columns(), "learned_scale": self.learned_scale}

    def columns(self) -> dict[str, Array]:
        """See ColumnState."""
        return {
            "value": self.value,
            "commissioned": self.commissioned,
            "intervals": self.intervals,
            "unsteady_intervals": self.unsteady_intervals,
            "interval_means": self.interval_means,
            "interval_information": self.interval_information,
            "total_information": self.total_information,
            "sums": self._sums[0],
            "scaling_squares": self._sums[1],
            "squares": self._sums[2],
            "counts": self._counts,
        }


def _weighted_median(means: Array, weights: Array) -> Array:
    """(fans,) weighted median of (intervals, fans); the plain median where all weights are equal."""
    order = np.argsort(means, axis=0)  # NaN, of weight zero, come last
    ordered = np.nan_to_num(np.take_along_axis(means, order, axis=0))
    weights = np.take_along_axis(np.maximum(weights, MIN_INFORMATION) * np.isfinite(means), order, axis=0)
    centres = np.cumsum(weights, axis=0) - weights / 2.0
    half = weights.sum(axis=0) / 2.0
    return np.array(
        [
            np.interp(half[k], centres[weights[:, k] > 0, k], ordered[weights[:, k] > 0, k])
            for k in range(means.shape[1])
        ]
    )
