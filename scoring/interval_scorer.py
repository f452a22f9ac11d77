"""The residuals of samples through their detectors, interval by interval of the baselines, or several at once.

What baselines learn from an interval depends on its scores, and later scores depend on what they learned. Where they
only refine what they have, intervals are scored together: it is guessed that baselines learn from each of them, and
the samples are scored again with what the scores say, until that stays. The first interval is right at once, and each
time at least one more, so the result is that of one interval after the other, to the bit.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from schemas.messages import Array
from scoring.baseline.baseline import MIN_STEADY_READINGS
from scoring.baseline.intervals import Intervals, first_end
from scoring.baseline.movement import Movement
from scoring.column_state import ColumnState
from scoring.detectors.detector import Detector, DetectorInput, Signal
from scoring.piece import Piece
from scoring.residual import Residual
from scoring.residual_samples import SampledResidual, ScoredResidual

HALF_LIMIT = 0.5  # once a fan is commissioned, baselines learn only below this score
PlacedDetectors = Sequence[tuple[int, Detector]]
"""Detectors, and their places in the table."""


class IntervalScorer(ColumnState):
    """Scores the residuals of one tray's fans; keeps what the present interval is worth to the baselines."""

    def __init__(
        self,
        fans: int,
        residuals: Mapping[Signal, Residual],
        detectors_of: Mapping[Signal, PlacedDetectors],
        *,
        interval_ns: int,
        counts: Array,
        held_ns: Array,
        movement: Movement,
    ) -> None:
        """detectors_of: of each residual. counts: (fans,) whose readings go up and down in steps as the speed changes.
        held_ns: (fans,) how long readings are held. movement: of the fans, kept by the caller.
        """
        self._residuals = residuals
        self._detectors_of = detectors_of
        self.in_use: list[Signal] = [source for source in residuals if detectors_of[source]]
        """residuals with detectors"""
        self.interval_ns = interval_ns
        self._counts = counts
        self._held_ns = held_ns
        self._movement = movement
        self.interval = 0
        """the number of the present one"""
        self._below_half_limit = np.ones(fans, np.bool_)
        """(fans,) whether every statistic stayed below half of its limit in the present interval so far"""
        self._within_limit = np.ones(fans, np.bool_)
        """(fans,) whether none exceeded its limit"""

    def score(self, piece: Piece, begin: int, numbers: Array, *, spans: bool, highest: float | None) -> int:
        """Score the samples of one interval from the row `begin` on, or of several. Returns the number of rows.

        numbers: (rows left,) the interval of each. spans: of several, as far as they can be scored together. highest:
        the last of them is the first in which a score exceeds it; None: whatever they are.
        """
        if numbers[0] != self.interval:
            self._end_interval(piece.samples.period_ns)
        intervals = Intervals.of(numbers, self.interval_ns // piece.samples.period_ns)
        if len(intervals) > 1 and not (spans and self._only_refines(piece, slice(begin, begin + intervals.rows))):
            intervals = intervals.first(1)
        rows = self._score(piece, begin, intervals, highest)
        self.interval = int(numbers[rows - 1])
        return rows

    def learn_nothing(self, fans: Array) -> None:
        """The baselines of some fans, (fans,) of bool, learn nothing from the present interval: those with an alarm. A
        fan without a baseline gets one.
        """
        if fans.any():
            has_one = np.any([residual.baseline.is_set for residual in self._residuals.values()], axis=0)
            self._below_half_limit[fans & has_one] = self._within_limit[fans & has_one] = False

    def restart(self, fans: Array) -> None:
        """Some fans, (fans,) of bool, are commissioned again."""
        self._below_half_limit[fans] = self._within_limit[fans] = True

    def snapshot(self) -> dict[str, Any]:
        """The state as JSON can hold it."""
        return {"interval": self.interval, **super().snapshot()}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Continue from a snapshot. Raises as ColumnState.restore does."""
        super().restore(state)
        self.interval = int(state["interval"])

    def columns(self) -> dict[str, Array]:
        """See ColumnState."""
        return {"below_half_limit": self._below_half_limit, "within_limit": self._within_limit}

    def _end_interval(self, period_ns: int) -> None:
        expected = self.interval_ns // period_ns
        moving = self._movement.end_interval(self._commissioning)
        few_readings = self.interval_ns / np.maximum(self._held_ns, period_ns) < MIN_STEADY_READINGS
        for residual in self._residuals.values():
            residual.end_interval(expected, self._within_limit, self._below_half_limit, moving, few_readings)
        self._below_half_limit[:] = self._within_limit[:] = True

    def _score(self, piece: Piece, begin: int, intervals: Intervals, highest: float | None) -> int:
        """Score the samples of the present interval, and of later ones, as far as they can be scored together.

        begin: the row of the first. highest: the score that ends it, if it is exceeded in an interval: None for any.
        Returns the number of rows.
        """
        sampled, moved = self._sampled(piece, begin, intervals)
        together = self._together(sampled, intervals)
        if together < len(intervals):
            intervals = intervals.first(together)
            sampled, moved = self._sampled(piece, begin, intervals)
        below_half_limit = np.ones((len(intervals), len(self._below_half_limit)), np.bool_)
        before = self._detector_columns() if together > 1 else []
        while True:
            of, score = self._scored(piece, slice(begin, begin + intervals.rows), sampled, below_half_limit)
            largest = intervals.largest(score)
            guessed, below_half_limit = below_half_limit, largest <= HALF_LIMIT
            below_half_limit[0] &= self._below_half_limit
            if len(intervals) == 1:
                break
            if not np.array_equal(guessed[:-1], below_half_limit[:-1]):
                self._restore_detectors(before)
                continue
            ends = len(intervals) if highest is None else first_end(largest.max(axis=1) > highest)
            if ends == len(intervals):
                break
            self._restore_detectors(before)
            intervals = intervals.first(ends)
            sampled, moved = self._sampled(piece, begin, intervals)
            below_half_limit = below_half_limit[:ends]
        within_limit = largest <= 1.0
        within_limit[0] &= self._within_limit
        self._below_half_limit, self._within_limit = below_half_limit[-1], within_limit[-1]
        for source, residual in self._residuals.items():
            residual.take(sampled[source], of[source])
            piece.scored[source].append(of[source])
        self._movement.take(moved, self._commissioning)
        return intervals.rows

    @property
    def _commissioning(self) -> Array:
        """(fans,) whether the baseline of a residual is being commissioned."""
        return np.any([residual.baseline.is_commissioning for residual in self._residuals.values()], axis=0)

    def _only_refines(self, piece: Piece, rows: slice) -> bool:
        """Whether these samples only refine baselines that are commissioned."""
        return all(
            residual.baseline.only_refined(piece.residuals[source].valid[rows])
            for source, residual in self._residuals.items()
        )

    def _together(self, sampled: Mapping[Signal, SampledResidual], intervals: Intervals) -> int:
        """How many of the intervals can be scored together."""
        if len(intervals) == 1:
            return 1
        return min(residual.runs_up_to(sampled[source]) for source, residual in self._residuals.items())

    def _detector_columns(self) -> list[dict[str, Array]]:
        """Copies of the state of the detectors of residuals."""
        return [
            {name: column.copy() for name, column in detector.columns().items()}
            for detectors in self._detectors_of.values()
            for _, detector in detectors
        ]

    def _restore_detectors(self, states: Sequence[Mapping[str, Array]]) -> None:
        detectors = [detector for of_source in self._detectors_of.values() for _, detector in of_source]
        for detector, state in zip(detectors, states, strict=True):
            detector.restore(state)

    def _sampled(self, piece: Piece, begin: int, intervals: Intervals) -> tuple[dict[Signal, SampledResidual], Array]:
        """The residuals at these samples, and the sums of the fans' movement."""
        rows = slice(begin, begin + intervals.rows)
        moved = self._movement.over(piece.movement[:, rows], intervals)
        moving = self._movement.moving(moved, self._commissioning) if len(intervals) > 1 else None
        return {
            source: residual.over(piece.residuals[source].rows(rows), intervals, moving)
            for source, residual in self._residuals.items()
        }, moved

    def _scored(
        self, piece: Piece, rows: slice, sampled: Mapping[Signal, SampledResidual], below_half_limit: Array
    ) -> tuple[dict[Signal, ScoredResidual], Array]:
        """The residuals less their baselines, and (n, fans) the score; both also in the piece."""
        samples, scores, ratios = piece.samples, piece.scores, piece.ratios[:, rows]
        alive, at_rest = samples.alive[rows], piece.at_rest[rows]
        scored_now = np.zeros(alive.shape, np.bool_)
        found: dict[Signal, ScoredResidual] = {}
        for source, residual in self._residuals.items():
            found[source] = of = residual.score(sampled[source], below_half_limit)
            given = piece.given(of.scored, rows, self._unsteadiness(of), of.persistent)
            detect(self._detectors_of[source], given, ratios)
            if source in self.in_use:
                scored_now |= of.scored
        score = np.fmax.reduce(ratios, axis=0, initial=0.0)
        has_score = scored_now | (alive & (score > 1.0))
        scores.score[rows] = np.where(has_score, score, np.nan)
        scores.judged[rows] = has_score | (alive & at_rest)
        scores.ratios[rows] = ratios.swapaxes(0, 1)
        if at_rest.any():
            for number, row in enumerate(piece.table):
                if row.source == "tacho" and not row.comes_first:
                    scores.ratios[rows, number][at_rest] = np.nan
        return found, score

    def _unsteadiness(self, of: ScoredResidual) -> Array:
        """(n, fans) the residual in standard deviations; of a tacho that counts, in those of this motion."""
        return np.where(self._counts, of.persistent, of.standardised) if self._counts.any() else of.standardised


def detect(detectors: PlacedDetectors, given: DetectorInput, ratios: Array) -> None:
    """Write the ratios of the detectors of one input into (rows of the table, n, fans), where it is valid."""
    for number, detector in detectors:
        np.copyto(ratios[number], detector.update(given), where=given.valid)
