"""Priors that healthy recordings have narrowed or widened.

Three of them differ most between makes of fan and places, and show in any healthy run: the wandering of the speed over
seconds, what the air does over minutes, and how far fans and runs differ in the mean. The first two follow from how
much more two stretches of steady running differ the farther apart they are, in which the noise of the tacho cancels.
A tacho that counts pulses hides both: of such fans only the means are learned from.

What was measured on a few fan-hours is not what the next month brings. So the logarithm of a variance is a weighted
mean of what was measured and of the prior: the prior counts as one fan's measurement on one day would, but where more
than the prior was measured, only the number of stretches counts against it.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cached_property

import numpy as np

from bench.detection.one_model.bins import Bins, bin_ns_of
from bench.detection.one_model.healthy import Priors
from bench.detection.one_model.operation import Fans, Inputs, Operation
from pipeline.runtime.tray_twin import TrayTwin
from schemas.messages import Array, Prediction
from schemas.units import NS_PER_S

STRETCH_S = 2.0
NEAR, FAR, FARTHEST = 2, 5, 15
"""distances of the stretches that are compared, in stretches"""
STEADY, SLOWEST = 0.02, 0.1
"""shares of the top speed: largest movement within what is compared, as of the load, and least speed"""
FEWEST = 30
"""pairs of stretches; from fewer nothing is learned"""
POPULATION = 2.0
"""variance of the logarithm of a variance, between makes of fan"""
DAY = 1.0
"""the same between days, of one fan"""
LEAST = 0.05
"""share of a prior standard deviation: no smaller one is believed"""


class HealthyRuns:
    """Healthy running of one twin's fans, as far as it tells of the priors."""

    def __init__(self, twin: TrayTwin) -> None:
        """Begin without a run."""
        self._twin, self._fans = twin, Fans.of_twin(twin)
        self._bin_ns = 0
        self._runs: dict[str, tuple[Bins, Operation, list[Inputs]]] = {}
        self._fan_days = 0.0
        self._means: list[Array] = []
        """mean deviations of the fans that were seen, of each run"""
        self._squares = {apart: np.zeros(2) for apart in (NEAR, FAR, FARTHEST)}
        """number of pairs of stretches, and sum of the squares of their differences"""

    def take(self, run: str, block: Prediction) -> None:
        """Add predictions of a run, in order of time."""
        if run not in self._runs:
            self._bin_ns = bin_ns_of(block.period_ns, float(self._fans.held_s.min()))
            bins = Bins(self._bin_ns, self._fans.top_rad_s, self._twin.unseen_error)
            self._runs[run] = bins, Operation(self._fans, self._bin_ns), []
        bins, operation, inputs = self._runs[run]
        inputs += [operation.inputs(one) for one in bins.take(block)]

    def _end(self, inputs: list[Inputs]) -> None:
        """Add up what a run tells."""
        speed = np.array([now.speed_rad_s for now in inputs])
        is_known = np.array([now.readings > 0 for now in inputs]) & (speed > SLOWEST * self._fans.top_rad_s)
        share = np.where(is_known, np.array([now.deviation_rad_s for now in inputs]), 0.0) / np.maximum(speed, 1.0)
        bin_s = self._bin_ns / NS_PER_S
        self._fan_days += len(inputs) * bin_s * len(self._fans.top_rad_s) / 86400.0
        counts = is_known.sum(axis=0)
        self._means.append((share.sum(axis=0) / np.maximum(counts, 1))[counts > 0])
        long = max(1, round(STRETCH_S / bin_s))
        parts = (len(share) // long, long, share.shape[1])
        rows = parts[0] * long
        known, speeds = is_known[:rows].reshape(parts), speed[:rows].reshape(parts)
        loads = np.array([now.load for now in inputs])[:rows].reshape(parts)
        turned = speeds.max(axis=1) - speeds.min(axis=1) > STEADY * self._fans.top_rad_s
        turned |= loads.max(axis=1) - loads.min(axis=1) > STEADY
        total = share[:rows].reshape(parts).sum(axis=1)
        means = np.where(known.any(axis=1) & ~turned, total / np.maximum(known.sum(axis=1), 1), np.nan)
        self._compare(means, speeds.mean(axis=1), loads.mean(axis=1), np.cumsum(turned, axis=0))

    def _compare(self, means: Array, speeds: Array, loads: Array, turns: Array) -> None:
        """All (stretches, fans): means of deviation, speed and load, and how many have moved until then."""
        for apart in self._squares:
            if len(means) > apart:
                stays = turns[apart:] == turns[:-apart]
                stays &= np.abs(speeds[apart:] - speeds[:-apart]) < STEADY * self._fans.top_rad_s
                stays &= (np.abs(loads[apart:] - loads[:-apart]) < STEADY) & (self._fans.pulse_rad_s == 0.0)
                differences = (means[apart:] - means[:-apart])[stays]
                self._squares[apart] += np.isfinite(differences).sum(), np.nansum(np.square(differences))

    @cached_property
    def priors(self) -> Priors:
        """What remains of the priors; no more can be taken afterwards."""
        for _, _, inputs in self._runs.values():
            if inputs:
                self._end(inputs)
        self._runs.clear()
        priors = Priors()
        step_s, wander_s, air_s = STRETCH_S, priors.wander_s, priors.air_s
        within = _same(NEAR * step_s, wander_s, step_s) - _same(FAR * step_s, wander_s, step_s)
        drifts = math.exp(-FAR * step_s / air_s) - math.exp(-FARTHEST * step_s / air_s)
        squares = np.square(np.concatenate([np.zeros(0), *self._means]))
        return replace(
            priors,
            wander=self._between(priors.wander, *self._grown(NEAR, FAR, within)),
            air=self._between(priors.air, *self._grown(FAR, FARTHEST, drifts)),
            twin_share=self._between(priors.twin_share, float(squares.sum()) / max(len(squares), 1), len(squares)),
        )

    def _grown(self, near: int, far: int, share: float) -> tuple[float, float]:
        """The variance of which a share makes stretches that are farther apart differ more, at the upper end of its
        standard error; and the number of independent pairs."""
        numbers = np.array([self._squares[apart][0] / apart for apart in (near, far)])
        if numbers.min() < 1.0:
            return 0.0, 0.0
        variances = np.array([self._squares[apart][1] / self._squares[apart][0] / 2.0 for apart in (near, far)])
        error = math.sqrt(float(np.sum(np.square(variances) * 2.0 / numbers)))
        return (max(float(variances[1] - variances[0]), 0.0) + error) / share, float(numbers.min())

    def _between(self, prior: float, variance: float, number: float) -> float:
        """A standard deviation between the prior one and that of a measured variance. number: of measurements."""
        if number < 1.0 or (number < FEWEST and variance < prior**2):
            return prior
        measured = math.log(max(variance, (LEAST * prior) ** 2))
        error = 2.0 / number + (DAY / max(self._fan_days, 1e-9) if measured < 2.0 * math.log(prior) else 0.0)
        weight = POPULATION / (POPULATION + error)
        return math.exp(0.5 * (weight * measured + (1.0 - weight) * 2.0 * math.log(prior)))


def _same(apart_s: float, time_s: float, stretch_s: float) -> float:
    """Covariance of the means of two stretches of an Ornstein-Uhlenbeck process of variance 1."""
    long = stretch_s / time_s
    return math.exp(-(apart_s - stretch_s) / time_s) * (-math.expm1(-long) / long) ** 2
