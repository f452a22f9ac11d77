"""Learned priors: those that healthy recordings have narrowed or widened.

Three of them differ most between makes of fan and places, and show in any healthy run: the wandering of the speed over
seconds, what the air does over minutes, and how far fans and runs differ on average. The first two follow from how
much more two segments of steady running differ the farther apart they are, in which the noise of the tacho cancels.
A tacho that counts pulses hides both: of such fans only the means are learned from.

A few fan-hours do not show the next month. So the logarithm of each variance is a weighted mean of the measured one and
the prior. If the measured one is smaller, the prior counts as much as a day's measurement of one fan. If it is larger,
only the number of segments limits its weight.

Each run is added up on its own, in bounded memory. The sums of many runs give the same priors in any order.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fantwin.schemas.messages import Array
from fantwin.schemas.units import NS_PER_S
from fantwin.scoring.model.bins import Bin
from fantwin.scoring.model.operation import Fans, Inputs, Operation
from fantwin.scoring.model.population import Priors

SEGMENT_S = 2.0
NEAR, FAR, FARTHEST = 2, 5, 15
"""distances of the segments that are compared, in segments"""
STEADY, SLOWEST = 0.02, 0.1
"""largest movement of the speed, share of the top speed, and of the load within what is compared; and least speed"""
COMPARED_AT_ONCE = 500
"""segments that are kept until they are compared"""
FEWEST = 30
"""pairs of segments; from fewer nothing is learned"""
POPULATION = 2.0
"""variance of the logarithm of a variance, between makes of fan"""
DAY = 1.0
"""the same between days, of one fan"""
LEAST = 0.05
"""least share of a prior standard deviation that is believed"""
LARGEST_LOG = 6.0
"""largest logarithm of the ratio of a variance to its prior that is looked at"""
SECONDS_PER_DAY = 86400.0


@dataclass(frozen=True, eq=False)
class RunSums:
    """Sums of one run of the fans of a tray, from which priors are learned."""

    judged_s: Array
    """(fans,) time in which a fan was compared with its twin"""
    mean_share: Array
    """(fans,) mean deviation from the twin, share of the speed; NaN of a fan that did not turn"""
    pairs: Array
    """(3,) number of pairs of segments that lie NEAR, FAR and FARTHEST apart"""
    squares: Array
    """(3,) sum of the squares of their differences"""


@dataclass(frozen=True, eq=False)
class _Segments:
    """Segments of running that follow one another. All (segments, fans)."""

    mean: Array
    """deviation, share of the speed; NaN where the fan moved or was not compared"""
    speed_rad_s: Array
    load: Array
    moved: Array

    @staticmethod
    def joined(parts: Sequence[_Segments]) -> _Segments:
        """Join several parts, one after another."""
        return _Segments(*map(np.concatenate, zip(*(vars(part).values() for part in parts), strict=True)))

    def last(self, count: int) -> _Segments:
        """The last ones."""
        return _Segments(*(values[-count:] for values in vars(self).values()))


class HealthyRun:
    """Run of healthy fans, added up bin by bin."""

    def __init__(self, fans: Fans, bin_ns: int) -> None:
        """Begin without a bin."""
        count = len(fans.top_rad_s)
        self._fans, self._bin_s = fans, bin_ns / NS_PER_S
        self._operation = Operation(fans, bin_ns)
        self._per_segment = max(1, round(SEGMENT_S / self._bin_s))
        self._inputs: list[Inputs] = []
        self._new: list[_Segments] = []
        nothing = np.zeros((0, count))
        self._compared = _Segments(nothing, nothing, nothing, nothing.astype(np.bool_))
        """the last ones that have been compared with those before them"""
        self._judged_s, self._readings, self._shares = np.zeros((3, count))
        self._pairs, self._squares = np.zeros((2, 3))

    def take(self, one: Bin) -> None:
        """Add a bin; bins come in order of time."""
        self._judged_s += self._bin_s * ((one.readings > 0) | (one.balances > 0))
        now = self._operation.inputs(one)
        counts = np.isfinite(self._operation.samples_rad_s(one, now)) & ~one.wrong
        self._inputs.append(self._operation.read(one, now, counts))
        if len(self._inputs) == self._per_segment:
            self._new.append(self._segment())
            if len(self._new) == COMPARED_AT_ONCE:
                self._compare()

    @property
    def sums(self) -> RunSums:
        """Sums of the bins so far."""
        if self._inputs:
            self._segment()  # too short to be compared, and part of the mean
        if self._new:
            self._compare()
        mean = np.where(self._readings > 0, self._shares / np.maximum(self._readings, 1), np.nan)
        return RunSums(self._judged_s.copy(), mean, self._pairs.copy(), self._squares.copy())

    def _segment(self) -> _Segments:
        """The inputs since the last one, taken together."""
        inputs, self._inputs = self._inputs, []
        speed, load = np.array([now.speed_rad_s for now in inputs]), np.array([now.load for now in inputs])
        known = np.array([now.readings > 0 for now in inputs]) & (speed > SLOWEST * self._fans.top_rad_s)
        share = np.where(known, np.array([now.deviation_rad_s for now in inputs]), 0.0) / np.maximum(speed, 1.0)
        count, total = known.sum(axis=0), share.sum(axis=0)
        self._readings += count
        self._shares += total
        moved = (np.ptp(speed, axis=0) > STEADY * self._fans.top_rad_s) | (np.ptp(load, axis=0) > STEADY)
        mean = np.where((count > 0) & ~moved, total / np.maximum(count, 1), np.nan)
        return _Segments(*(row[np.newaxis] for row in (mean, speed.mean(axis=0), load.mean(axis=0), moved)))

    def _compare(self) -> None:
        """Compare each new segment with those before it."""
        old = len(self._compared.mean)
        segments = _Segments.joined([self._compared, *self._new])
        self._new = []
        turns = np.cumsum(segments.moved, axis=0)
        for which, apart in enumerate((NEAR, FAR, FARTHEST)):
            first, second = slice(max(old - apart, 0), -apart), slice(max(old, apart), None)
            speed, load = segments.speed_rad_s, segments.load
            is_steady = (turns[second] == turns[first]) & (self._fans.pulse_rad_s == 0.0)
            is_steady &= np.abs(speed[second] - speed[first]) < STEADY * self._fans.top_rad_s
            is_steady &= np.abs(load[second] - load[first]) < STEADY
            differences = (segments.mean[second] - segments.mean[first])[is_steady]
            self._pairs[which] += np.isfinite(differences).sum()
            self._squares[which] += np.nansum(np.square(differences))
        self._compared = segments.last(FARTHEST)


def learned_priors(runs: Sequence[RunSums]) -> Priors:
    """Return the priors of a population, narrowed or widened by healthy runs, in any order."""
    priors = Priors()
    fan_days = math.fsum(float(judged_s) for run in runs for judged_s in run.judged_s) / SECONDS_PER_DAY
    pairs = [math.fsum(run.pairs[which] for run in runs) for which in range(3)]
    squares = [math.fsum(run.squares[which] for run in runs) for which in range(3)]
    means = [float(share) for run in runs for share in run.mean_share if math.isfinite(share)]
    of_means = math.fsum(share**2 for share in means) / max(len(means), 1)

    step_s, wander_s, air_s = SEGMENT_S, priors.wander_s, priors.air_s
    within = _same(NEAR * step_s, wander_s, step_s) - _same(FAR * step_s, wander_s, step_s)
    drifts = math.exp(-FAR * step_s / air_s) - math.exp(-FARTHEST * step_s / air_s)
    return replace(
        priors,
        wander=_of_growth(priors.wander, pairs[:2], squares[:2], (NEAR, FAR), within, fan_days),
        air=_of_growth(priors.air, pairs[1:], squares[1:], (FAR, FARTHEST), drifts, fan_days),
        twin_share=_between(priors.twin_share, of_means, len(means), fan_days),
    )


def _of_growth(
    prior: float, pairs: list[float], squares: list[float], apart: tuple[int, int], share: float, fan_days: float
) -> float:
    """Return the standard deviation of what makes segments that are farther apart differ more, by a share of its
    variance. pairs, squares, apart: of the nearer and the farther ones.

    Its variance is log-normal around the prior, and the growth is known with the error of two estimated variances; the
    upper end of the standard error of the logarithm is returned. A growth that noise hides says little against the
    prior.
    """
    numbers = [number / distance for number, distance in zip(pairs, apart, strict=True)]
    if min(numbers) < 1.0:
        return prior
    near, far = (total / number / 2.0 for total, number in zip(squares, pairs, strict=True))
    error = math.sqrt(near**2 * 2.0 / numbers[0] + far**2 * 2.0 / numbers[1])
    logs = np.linspace(-LARGEST_LOG, LARGEST_LOG, 401)
    misfit = (far - near - share * prior**2 * np.exp(logs)) / error if error > 0.0 else np.zeros_like(logs)
    density = -0.5 * (np.square(misfit) + np.square(logs) / POPULATION)
    weights = np.exp(density - density.max())
    mean = float(weights @ logs / weights.sum())
    log = mean + math.sqrt(float(weights @ np.square(logs - mean) / weights.sum()))
    if log < 0.0:
        log *= POPULATION / (POPULATION + DAY / max(fan_days, 1e-9))
    return prior * math.exp(0.5 * log)


def _between(prior: float, variance: float, number: float, fan_days: float) -> float:
    """Weigh a measured variance against a prior standard deviation; return a standard deviation. number: of
    measurements."""
    if number < 1.0 or (number < FEWEST and variance < prior**2):
        return prior
    measured = math.log(max(variance, (LEAST * prior) ** 2))
    error = 2.0 / number + (DAY / max(fan_days, 1e-9) if measured < 2.0 * math.log(prior) else 0.0)
    weight = POPULATION / (POPULATION + error)
    return math.exp(0.5 * (weight * measured + (1.0 - weight) * 2.0 * math.log(prior)))


def _same(apart_s: float, time_s: float, segment_s: float) -> float:
    """Covariance of the means of two segments of an Ornstein-Uhlenbeck process of variance 1."""
    long = segment_s / time_s
    return math.exp(-(apart_s - segment_s) / time_s) * (-math.expm1(-long) / long) ** 2
