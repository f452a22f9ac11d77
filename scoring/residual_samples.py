"""A residual at samples, as it goes through the scorer: before the baselines, with them, and of a whole piece."""

from __future__ import annotations

from dataclasses import dataclass

from schemas.messages import Array
from scoring.baseline.baseline import BaselineState, IntervalSums
from scoring.baseline.intervals import Intervals
from scoring.baseline.shared_offset import SharedOverIntervals


@dataclass(frozen=True, eq=False)
class ResidualSamples:
    """A residual at some samples, (n, fans) each, and all that follows from it without the baselines."""

    valid: Array
    residual: Array
    """less the expected one, sigma"""
    expected: Array
    """the mean healthy residual at these speeds, sigma"""
    scaling: Array
    """the baseline at these speeds, relative to that at the reference speed"""
    std: Array
    """standard deviation of the healthy residual, sigma"""
    low_frequency_std: Array
    """of its low frequencies at this speed and in this motion, relative to their median; more where the twin may be
    wrong because it was not trained there"""
    seen: Array
    """where the twin was trained: elsewhere its own error is no offset of the fan to be learned"""
    clip: float
    """how far samples count, standard deviations"""
    reach: Array
    """how far from the baseline they are learned, sigma"""
    speed_sigmas: Array
    """the speed over sigma, with its sign: a shared offset is in proportion to it"""

    def rows(self, rows: slice) -> ResidualSamples:
        """Some of the samples."""
        return ResidualSamples(
            self.valid[rows],
            self.residual[rows],
            self.expected[rows],
            self.scaling[rows],
            self.std[rows],
            self.low_frequency_std[rows],
            self.seen[rows],
            self.clip,
            self.reach[rows],
            self.speed_sigmas[rows],
        )


@dataclass(frozen=True, eq=False)
class ScoredResidual:
    """A residual less its baseline, (n, fans) each; and the baselines of the intervals of these samples."""

    scored: Array
    """valid, and with a baseline"""
    standardised: Array
    persistent: Array
    """see DetectorInput"""
    shift: Array
    """the residual less the expected one and the baseline, sigma; 0 where not scored"""
    baseline: Array
    """at this speed, sigma, with what the fans share"""
    shared: Array
    """that part of it"""
    intervals: Intervals
    state: BaselineState
    sums: IntervalSums
    """of what the baselines learn from these intervals"""


@dataclass(frozen=True, eq=False)
class SampledResidual:
    """A residual at the samples of some intervals, with what does not depend on what baselines learn from each."""

    of: ResidualSamples
    intervals: Intervals
    over: SharedOverIntervals | None
    """None where nothing is shared"""
    shared: Array
    """(n, fans) sigma"""
    residual: Array
    """(n, fans) less the expected one and what is shared, sigma"""
    learned: Array
    """(n, fans) where baselines learn from it"""


JOINED = ("scored", "persistent", "shift", "baseline", "shared")


@dataclass(frozen=True, eq=False)
class JoinedResidual:
    """A residual in successive intervals, (n, fans) each."""

    scored: Array
    """this and the next four: see ScoredResidual"""
    persistent: Array
    shift: Array
    baseline: Array
    shared: Array
    commissioned: Array
    """the fan's own baseline at the end of commissioning, at the reference speed; NaN before"""
    independent_intervals: Array
    at_limit: Array
    learned_scale: Array
    """see Baseline"""
