"""Samples without a gap between them while they are scored.

What does not depend on the baselines is found for the whole piece at once. The rest is scored in stretches
of whole intervals of the baselines: what they learn from one interval counts in the next.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from schemas.enums import Statistic
from schemas.messages import Array
from schemas.units import NS_PER_S
from scoring.detectors.detector import DetectorInput, DetectorRow, Signal
from scoring.residual_samples import JoinedResidual, ResidualSamples, ScoredResidual
from scoring.samples import Samples
from scoring.scored_block import Observation, ScoredBlock

NO_STATISTIC = int(Statistic.NONE)
NOTHING = np.zeros((0, 0))


@dataclass(frozen=True, eq=False, kw_only=True)
class Piece:
    """A piece, and its scores so far."""

    samples: Samples
    table: Sequence[DetectorRow]
    transient_rad_s: Array
    """(n, fans) see scoring.detectors.motion"""
    movement: Array
    """see Movement.samples"""
    residuals: dict[Signal, ResidualSamples]
    ratios: Array
    """(rows of the table, n, fans) every statistic in multiples of its limit; NaN where there is none"""
    at_rest: Array
    """(n, fans) where only the detectors of standstill say anything"""
    scored: dict[Signal, list[ScoredResidual]]
    """of each residual, in stretches"""
    scores: ScoredBlock
    """score, judged and ratios are those of the stretches so far; the others are there when it is complete"""

    @property
    def period_s(self) -> float:
        """Sampling period."""
        return self.samples.period_ns / NS_PER_S

    def given(
        self, valid: Array, rows: slice = slice(None), standardised: Array = NOTHING, persistent: Array = NOTHING
    ) -> DetectorInput:
        """What detectors are given of some rows; the tacho has no residual."""
        samples = self.samples
        return DetectorInput(
            period_ns=samples.period_ns,
            period_s=self.period_s,
            valid=valid,
            standardised=standardised,
            persistent=persistent,
            speed_rad_s=samples.speed_rad_s[rows],
            missing=samples.missing[rows],
            reading_missing=samples.reading_missing[rows],
            idle=samples.idle[rows],
            command=samples.command[rows],
            predicted_rad_s=samples.predicted_rad_s[rows],
        )

    def complete(
        self,
        scored: Mapping[Signal, JoinedResidual],
        smoothed: Mapping[Signal, Array],
        in_use: Sequence[Signal],
        baseline_s: float,
    ) -> None:
        """Fill in the scores that nothing else depends on.

        scored: of all stretches. smoothed: see Residual.smooth. in_use: residuals with detectors. baseline_s: the
        interval of the baselines.
        """
        scores, ratios = self.scores, self._known_ratios
        largest = ratios.argmax(axis=0)
        for number, row in enumerate(self.table):
            if row.comes_first:
                largest = np.where(ratios[number] > 1.0, number, largest)
        statistics = np.array([row.statistic for row in self.table])
        scores.statistic[:] = np.where(np.isnan(scores.score), NO_STATISTIC, statistics[largest])
        known, scored_now = np.zeros((2, *scores.score.shape), np.bool_)
        for source in in_use:
            known |= self.residuals[source].valid
            scored_now |= scored[source].scored
        speed, balance = scored["speed"], scored["balance"]
        scores.commissioning[:] = known & ~scored_now
        scores.speed_smoothed[:], scores.speed_baseline[:] = smoothed["speed"], speed.baseline
        scores.speed_learned_scale[:] = speed.learned_scale
        scores.balance_smoothed[:], scores.balance_baseline[:] = smoothed["balance"], balance.baseline
        scores.balance_learned_scale[:] = balance.learned_scale
        scores.balance_shared[:] = balance.shared
        scores.balance_expected[:] = self.residuals["balance"].expected
        scores.balance_baseline_s[:] = balance.independent_intervals * baseline_s
        scores.balance_commissioned[:], scores.balance_at_limit[:] = balance.commissioned, balance.at_limit

    def observation(self, scored: Mapping[Signal, JoinedResidual]) -> Observation:
        """What calibration needs about it."""
        return Observation(
            ratios=self._known_ratios,
            persistent={source: of.persistent for source, of in scored.items()},
            expected={source: of.expected for source, of in self.residuals.items()},
            transient_rad_s=self.transient_rad_s,
        )

    @property
    def _known_ratios(self) -> Array:
        return np.where(np.isnan(self.ratios), 0.0, self.ratios)
