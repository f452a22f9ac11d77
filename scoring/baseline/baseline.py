"""Commissioning: what of a residual is this fan's, or this day's, own.

The time since a session's first sample is cut into intervals. The mean residual of the first one in which the residual
stays where it is becomes the baseline: a fan that starts from rest is not itself at first. But it is not waited for
longer than some intervals. While the fan is commissioned the baseline is the median of the means of its intervals;
afterwards good ones refine it, as a running mean and with a fixed time constant in the long run. Nothing is learnt from
an anomaly: while commissioning, from an interval with anything beyond its limit, and afterwards, from one that was not
far from every limit. While commissioning the baseline may not lie further from none than those of healthy fans do, and
afterwards not further from the commissioned one than the adaptation limit: what wears slowly gets there, and alarms.

A fan's own offset may go with its speed, as `shape` says: one at the speed where the baseline is what it is, and less
where it is slower. The mean of an interval is then by least squares, and an interval tells as much as the mean square
of its shape. What a twin is wrong by at a low speed must not be taken for much more of it at a high one: each mean is
drawn towards none, where healthy fans are, by ridge regression. At a larger shape than that of the intervals that told
most a baseline is known the less (`unknown`), the larger it is; there it is followed the faster, and the commissioned
one moves with it, by no more than was unknown.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from schemas.messages import Array

COMMISSIONING_INTERVALS = 10  # the baseline after so many is the commissioned one
GOOD_SHARE = 0.5  # of an interval's samples must be valid
ONE = 1 << 20  # of fixed point: one sigma
ONE_SQUARED = 1 << 20  # of fixed point: one sigma squared
WILD = 1e3  # sigma; a larger residual counts as this
STEADY = 2.0  # standard deviations of a healthy residual: more within an interval, and the fan is on its way somewhere
PATIENCE = 10  # intervals that may go by before an unsteady one will do
ROUNDING = 1e-9
UNUSUAL = 3.0  # times the root mean square: so far an offset may be
MORE = 1.5  # times as much told as by the one of those kept that told least: such an interval is followed the faster
LEAST_TOLD = 1e-12


@dataclass(frozen=True)
class BaselineSettings:
    """limits and spread in sigma; adaptation in intervals: the time constant in the long run."""

    farthest: float
    adaptation_limit: float
    adaptation_intervals: float
    spread: float = 1.0
    """standard deviation of the healthy residual"""
    ridge: float = 0.0
    """variance of what a baseline cannot follow, in that of healthy baselines"""
    usual: float = 0.0
    """root mean square of healthy baselines"""


class Baseline:
    """The baselines of one residual of a tray's fans where the shape is one, in sigma of each fan."""

    def __init__(self, fans: int, settings: BaselineSettings) -> None:
        self._settings = settings
        self.value = np.zeros(fans)
        """(fans,) sigma; zero before the first good interval"""
        self.commissioned = np.zeros(fans)
        """(fans,) sigma: the value of commissioning, at its end or so far"""
        self.intervals = np.zeros(fans, np.int64)
        """(fans,) good intervals so far"""
        self.waited = np.zeros(fans, np.int64)
        """(fans,) unsteady intervals before the first good one"""
        self.means = np.full((COMMISSIONING_INTERVALS, fans), np.nan)
        """sigma, of the good intervals that told most; while commissioning the baseline is their median"""
        self.told = np.zeros((COMMISSIONING_INTERVALS, fans))
        """how much each of them told"""
        self.worth = np.zeros(fans)
        """(fans,) how much all good intervals told together"""
        self.sums = np.zeros(fans, np.int64)
        self.shapes = np.zeros(fans, np.int64)
        self.squares = np.zeros(fans, np.int64)
        self.counts = np.zeros(fans, np.int64)

    @property
    def is_set(self) -> Array:
        """(fans,) whether a fan can be judged."""
        return self.intervals > 0

    @property
    def is_commissioning(self) -> Array:
        """(fans,) whether the baseline has yet to settle."""
        return self.intervals < COMMISSIONING_INTERVALS

    @property
    def is_at_limit(self) -> Array:
        """(fans,) whether the baseline would have gone further if it might."""
        limit = self._settings.adaptation_limit
        went = np.abs(self.value - self.commissioned)
        return self.is_set & (went >= limit * (1.0 - ROUNDING)) & (limit > 0)

    @property
    def weight(self) -> Array:
        """(fans,) of how many independent intervals the baseline varies as the mean."""
        in_the_long_run = 2.0 * self._settings.adaptation_intervals - 1.0
        return np.minimum(self.worth, in_the_long_run)

    def unknown(self, shape: Array) -> Array:
        """(n, fans) how far the fan's own offset may be from the baseline's at a shape, beyond what it is by, sigma."""
        return UNUSUAL * self._settings.usual * np.maximum(shape - self.reached, 0.0)

    @property
    def reached(self) -> Array:
        """(fans,) the shape where most was told."""
        weights = np.square(self.told)
        return np.sqrt((weights * self.told).sum(axis=0) / np.maximum(weights.sum(axis=0), LEAST_TOLD))

    def restart(self, fans: Array) -> None:
        """Commission some fans anew, (fans,) of bool."""
        for column in (
            self.value,
            self.commissioned,
            self.intervals,
            self.waited,
            self.worth,
            self.sums,
            self.shapes,
            self.squares,
            self.counts,
        ):
            column[fans] = 0
        self.means[:, fans] = np.nan
        self.told[:, fans] = 0.0

    def add(self, residual: Array, valid: Array, shape: Array | float = 1.0) -> None:
        """Note samples of the present interval, (n, fans) each; residual in sigma, shape finite."""
        known = np.clip(np.where(valid, residual, 0.0), -WILD, WILD)
        self.sums += np.rint(known * shape * ONE).astype(np.int64).sum(axis=0)
        self.shapes += np.rint(np.where(valid, shape * shape, 0.0) * ONE_SQUARED).astype(np.int64).sum(axis=0)
        self.squares += np.rint(known * known * ONE_SQUARED).astype(np.int64).sum(axis=0)
        self.counts += valid.sum(axis=0)

    def end_interval(self, samples: int, normal: Array, quiet: Array) -> Array:
        """End the present interval of so many samples. Returns which fans have just got a baseline.

        normal, quiet: (fans,) whether nothing was beyond its limit, and all far from it.
        """
        counts = np.maximum(self.counts, 1)
        told = self.shapes / counts / ONE_SQUARED
        product = self.sums / counts / ONE
        mean = product / np.maximum(told + self._settings.ridge, LEAST_TOLD)
        explained = product * product / np.maximum(told, LEAST_TOLD)
        deviation = np.sqrt(np.maximum(self.squares / counts / ONE_SQUARED - explained, 0.0))
        seen = (self.counts >= GOOD_SHARE * samples) & (self.counts > 0)
        unsteady = seen & ~self.is_set & (deviation > STEADY * self._settings.spread) & (self.waited < PATIENCE)
        self.waited += unsteady
        good = seen & ~unsteady & np.where(self.is_commissioning, normal, quiet)
        first = good & (self.intervals == 0)
        young = good & self.is_commissioning
        eager = good & ~young & (told > MORE * self.told.min(axis=0))
        worth = np.minimum(told, 1.0)
        self.worth += np.where(good, worth, 0.0)
        gain = worth / np.maximum(np.minimum(self.worth, self._settings.adaptation_intervals), LEAST_TOLD)
        reached = self.reached
        self._keep(mean, told, young | eager)
        share = np.square(told) / np.maximum(np.square(self.told).sum(axis=0), LEAST_TOLD)
        gain = np.where(eager, np.maximum(gain, share), gain)
        value = np.where(good, self.value + gain * (mean - self.value), self.value)
        if young.any():
            median = _median(self.means[:, young], np.square(self.told[:, young]))
            value[young] = np.clip(median, -self._settings.farthest, self._settings.farthest)
        moved = np.where(eager, UNUSUAL * self._settings.usual * np.maximum(self.reached - reached, 0.0), 0.0)
        commissioned = np.clip(value, self.commissioned - moved, self.commissioned + moved)
        limit = self._settings.adaptation_limit
        held = np.clip(value, commissioned - limit, commissioned + limit)
        self.value = np.where(young, value, held)
        self.commissioned = np.where(young, self.value, commissioned)
        self.intervals += good
        for column in (self.sums, self.shapes, self.squares, self.counts):
            column[:] = 0
        return first

    def _keep(self, mean: Array, told: Array, fans: Array) -> None:
        """Keep the means of some fans, each in the place of the one that told least."""
        least, each = self.told.argmin(axis=0), np.flatnonzero(fans)
        self.means[least[each], each] = mean[each]
        self.told[least[each], each] = told[each]


def _median(means: Array, weights: Array) -> Array:
    """(fans,) weighted median of (intervals, fans); that of the plain kind where all weights are alike."""
    order = np.argsort(means, axis=0)  # NaN, of weight zero, come last
    ordered = np.nan_to_num(np.take_along_axis(means, order, axis=0))
    weights = np.take_along_axis(np.maximum(weights, LEAST_TOLD) * np.isfinite(means), order, axis=0)
    centres = np.cumsum(weights, axis=0) - weights / 2.0
    half = weights.sum(axis=0) / 2.0
    return np.array(
        [
            np.interp(half[k], centres[weights[:, k] > 0, k], ordered[weights[:, k] > 0, k])
            for k in range(means.shape[1])
        ]
    )
