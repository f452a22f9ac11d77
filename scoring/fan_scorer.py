"""Scores the fans of a tray: both residuals and the tachos through every detector of the table.

The score of a fan is the largest ratio of a statistic to its limit. Above 1 the fan deviates from its healthy
behaviour. scoring.alarms decides whether that raises an alarm.

After a gap longer than its memory a statistic starts again: what a fan did before the gap says nothing about it now.
Baselines stay.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from schemas.messages import Array
from schemas.tacho import INSTANTANEOUS, Tacho, tacho_of_each_fan
from schemas.units import NS_PER_S
from scoring.baseline.movement import Movement
from scoring.column_state import ColumnState
from scoring.detectors.detector import Detector, DetectorContext, Signal
from scoring.detectors.motion import HealthyMotion, Motion
from scoring.detectors.smoothed import SmoothedSettings
from scoring.detectors.table import rows
from scoring.gaps import Gaps
from scoring.interval_scorer import IntervalScorer, detect
from scoring.limits import Limits
from scoring.piece import Piece
from scoring.residual import Residual
from scoring.residual_samples import JoinedResidual
from scoring.samples import Samples
from scoring.scored_block import Observation, ScoredBlock

RESIDUALS: tuple[Signal, ...] = ("speed", "balance")
INPUTS: tuple[Signal, ...] = (*RESIDUALS, "tacho")


class FanScorer:
    """Scores one tray's fans. The result does not depend on how samples are cut into blocks."""

    def __init__(
        self,
        fans: int,
        limits: Limits,
        *,
        tachos: Sequence[Tacho] = INSTANTANEOUS,
        for_calibration: bool = False,
    ) -> None:
        """for_calibration: keep what calibration needs, for `observed`; statistics then grow beyond their limits."""
        self.limits = limits
        self.residuals: dict[Signal, Residual] = {source: Residual(fans, source, limits) for source in RESIDUALS}
        contexts = {
            source: residual.context(fans, capped=not for_calibration) for source, residual in self.residuals.items()
        }
        of_each_fan = tacho_of_each_fan(tachos, fans)
        of_tacho = DetectorContext(
            fans=fans,
            smoothing_s=limits.timing.smoothing_s,
            capped=not for_calibration,
            tachos=of_each_fan,
        )
        self._rows = rows()
        self.detectors: dict[str, Detector] = {
            row.name: row.detector(limits.detectors[row.name], contexts.get(row.source, of_tacho))
            for row in self._rows
            if row.name in limits.detectors
        }
        """the detectors that have a limit, by name"""
        self._detectors_of: dict[Signal, list[tuple[int, Detector]]] = {
            source: [
                (number, self.detectors[row.name])
                for number, row in enumerate(self._rows)
                if row.source == source and row.name in self.detectors
            ]
            for source in INPUTS
        }
        """the detectors of each input, and their places in the table"""
        self._movement = Movement(fans)
        self._intervals = IntervalScorer(
            fans,
            self.residuals,
            {source: self._detectors_of[source] for source in RESIDUALS},
            interval_ns=max(1, round(limits.timing.baseline_s * NS_PER_S)),
            counts=np.array([tacho.held_s > 0.0 for tacho in of_each_fan]),
            held_ns=np.array([tacho.held_s * NS_PER_S for tacho in of_each_fan]),
            movement=self._movement,
        )
        self._judges_rest = any(row.only_at_rest and row.name in self.detectors for row in self._rows)
        self._motion = Motion(fans)
        self._healthy_motion = HealthyMotion(fans)
        self._gaps = Gaps(len(INPUTS), fans)
        self._memories = self._memories_ns()
        self._shortest_memory_ns = min(memory_ns for _, _, memory_ns in self._memories)
        self.origin_t_ns: int | None = None
        self._observations: list[Observation] | None = [] if for_calibration else None

    @property
    def held_baselines(self) -> Array:
        """(fans,) whether a baseline of a scored residual is held at its adaptation limit."""
        at_limit = [self.residuals[source].baseline.is_at_limit for source in self._intervals.in_use]
        return np.any(at_limit, axis=0)

    def update(self, block: Samples) -> ScoredBlock:
        """Score a block of at least one sample."""
        scores, stretches = self.stretches(block)
        for _ in stretches:
            pass
        return scores

    def stretches(
        self, block: Samples, may_span: Callable[[], bool] | None = None
    ) -> tuple[ScoredBlock, Iterator[slice]]:
        """Score a block of at least one sample in stretches.

        Returns the scores, and the rows of each stretch. Going on to the next stretch fills in its `score`, `judged`
        and `ratios`; all is filled in at the end. Between them the caller may decide what the interval of the baselines
        in which a stretch ends is worth, see `learn_nothing`.

        may_span: called before each stretch: whether it may span several intervals, if no score in those before the
        last exceeds 1. None: it may, whatever the scores are: the caller decides nothing.
        """
        scores = ScoredBlock.empty(len(block.t_ns), len(self._rows), block.alive.shape[1])
        return scores, self._each_stretch(block, scores, may_span)

    def _each_stretch(
        self, block: Samples, scores: ScoredBlock, may_span: Callable[[], bool] | None
    ) -> Iterator[slice]:
        if self.origin_t_ns is None:
            self.origin_t_ns = int(block.t_ns[0])
        of_samples = (block.t_ns - self.origin_t_ns) // self._intervals.interval_ns
        missing_ns = self._missing_ns(block)
        after_gap: Array = np.any(missing_ns > self._shortest_memory_ns, axis=(1, 2))
        for first, last in _parts(after_gap[1:]):
            if after_gap[first]:
                self._forget(missing_ns[first])
            piece = self._piece(block.rows(slice(first, last)), scores.rows(slice(first, last)))
            numbers, begin = of_samples[first:last], 0
            while begin < len(numbers):
                spans, highest = (True, None) if may_span is None else (may_span(), 1.0)
                rows = self._intervals.score(piece, begin, numbers[begin:], spans=spans, highest=highest)
                yield slice(first + begin, first + begin + rows)
                begin += rows
            self._complete(piece)

    def is_interval_over(self, t_ns: Array) -> bool | None:
        """Of a block of the times t_ns, (n,): whether it begins a new interval of the baselines. None: an interval
        ends within it, or no fan is commissioned yet, or a fan is being commissioned when an interval ends: NumPy adds
        up the column of a single such fan in another order than columns side by side.
        """
        residuals = self.residuals.values()
        if self.origin_t_ns is None or not all(residual.is_commissioned for residual in residuals):
            return None
        first, last = (self._interval_of(int(t)) for t in (t_ns[0], t_ns[-1]))
        is_over = first != self._intervals.interval
        if first != last or (is_over and any(residual.baseline.is_learning_first for residual in residuals)):
            return None
        return is_over

    def begin_block(self, t_ns: int, *, is_interval_over: bool) -> None:
        """Let an interval begin at t_ns, or go on from there."""
        self.origin_t_ns, self._intervals.interval = t_ns, -1 if is_interval_over else 0

    def skip_block(self, t_ns: int) -> None:
        """A block up to t_ns has been scored elsewhere, and the states of this one are those after it."""
        self._intervals.interval = self._interval_of(t_ns)

    def _interval_of(self, t_ns: int) -> int:
        assert self.origin_t_ns is not None
        return (t_ns - self.origin_t_ns) // self._intervals.interval_ns

    @property
    def states(self) -> list[ColumnState]:
        """All that is kept of each fan, apart from what fans share."""
        return [
            self._intervals,
            self._motion,
            *self._healthy_motion.states,
            self._movement,
            self._gaps,
            *self.detectors.values(),
            *(state for residual in self.residuals.values() for state in residual.states),
        ]

    def learn_nothing(self, fans: Array) -> None:
        """See IntervalScorer."""
        self._intervals.learn_nothing(fans)

    def observed(self) -> list[Observation]:
        """Observations since the last call, in the order of their samples; only if `for_calibration`."""
        assert self._observations is not None
        observations, self._observations = self._observations, []
        return observations

    def recommission(self, fans: Array) -> None:
        """Learn new baselines for some fans, (fans,) of bool."""
        for residual in self.residuals.values():
            residual.restart(fans)
            residual.reset(fans)
        for detector in self.detectors.values():
            detector.reset(fans)
        self._movement.restart(fans)
        self._intervals.restart(fans)

    @property
    def longest_memory_ns(self) -> int:
        """The longest memory of a detector in use, ns: after so many samples all statistics are of the present."""
        return max((round(detector.memory_s * NS_PER_S) for detector in self.detectors.values()), default=0)

    def limit_sigmas(self, source: Signal, period_s: float) -> float:
        """How far the smoothed residual may be from its baseline, sigma; infinite without that limit."""
        limits = [
            self.detectors[row.name].limit_sigmas(period_s)
            for row in self._rows
            if row.source == source and row.detector.settings is SmoothedSettings and row.name in self.detectors
        ]
        return min(limits, default=np.inf)

    def limit_at(
        self,
        source: Signal,
        speed_rad_s: Array,
        statistic: int,
        period_s: float,
        learned_scale: Array,
        unseen: Array,
    ) -> Array:
        """(fans,) how far the residual may be from its baseline at these speeds, sigma; infinite without a limit.

        By the detector of a statistic if that watches this residual and finds shifts; else by the smoothed residual.
        learned_scale, unseen: (fans,) at that time, see ScoredBlock and Samples.
        """
        of_source = [row for row in self._rows if row.source == source and row.name in self.detectors]
        limits = {row.statistic: self.detectors[row.name].limit_sigmas(period_s) for row in of_source}
        limit = limits.get(statistic, np.inf)
        if not np.isfinite(limit):
            limit = self.limit_sigmas(source, period_s)
        mean_std = self.limits.residual(source).mean_residual_std
        return limit / mean_std * self.residuals[source].limit_std(speed_rad_s, learned_scale, unseen)

    def persistent_limit_sigmas(self, source: Signal, period_s: float) -> float:
        """How far a shift that stays may be from the commissioned baseline, sigma; infinite without any limit.

        The baseline follows to its adaptation limit; the most sensitive detector reports what is left.
        """
        limits = [
            self.detectors[row.name].limit_sigmas(period_s)
            for row in self._rows
            if row.source == source and row.name in self.detectors
        ]
        adaptation = self.limits.residual(source).baseline.adaptation_limit_sigmas
        return adaptation + min(limits, default=np.inf)

    def _memories_ns(self) -> list[tuple[int, Callable[[Array], None], int]]:
        """What is forgotten over a gap: the number of its input, how to start it again, and its memory, ns."""
        forgotten: list[tuple[Signal, Callable[[Array], None], float]] = []
        for row in self._rows:
            if row.name in self.detectors:
                detector = self.detectors[row.name]
                forgotten.append((row.source, detector.reset, detector.memory_s))
        for source in RESIDUALS:
            forgotten.append((source, self.residuals[source].reset, self.residuals[source].memory_s))
        forgotten.append(("tacho", self._motion.reset, self._motion.memory_s))
        forgotten.append(("tacho", self._healthy_motion.reset, self._healthy_motion.memory_s))
        return [(INPUTS.index(source), reset, round(memory_s * NS_PER_S)) for source, reset, memory_s in forgotten]

    def _missing_ns(self, block: Samples) -> Array:
        """(n, inputs, fans) how long each input was missing before each of its samples, ns."""
        valid = np.array((block.speed_valid, block.balance_valid, block.alive)).swapaxes(0, 1)
        return self._gaps.update(block.t_ns, block.period_ns, valid)

    def _forget(self, missing_ns: Array) -> None:
        """Start again what remembers less than the gap before this sample, (inputs, fans) ns."""
        for number, reset, memory_ns in self._memories:
            fans = missing_ns[number] > memory_ns
            if fans.any():
                reset(fans)

    def _piece(self, samples: Samples, scores: ScoredBlock) -> Piece:
        """What follows from samples without the baselines. scores: of these samples, not filled in yet."""
        speed_rad_s, period_s = samples.speed_rad_s, samples.period_ns / NS_PER_S
        motion_rad_s = self._motion.update(speed_rad_s, period_s)
        healthy_rad_s = self._healthy_motion.update(samples.command, samples.predicted_rad_s, speed_rad_s, period_s)
        transient_rad_s = np.minimum(np.abs(motion_rad_s), healthy_rad_s)
        operating_rad_s = samples.operating_speed_rad_s(is_predicted=self.limits.over_predicted_speed)
        piece = Piece(
            samples=samples,
            transient_rad_s=transient_rad_s,
            movement=self._movement.samples(motion_rad_s, speed_rad_s),
            residuals={
                source: residual.samples(*samples.residual(source), operating_rad_s, transient_rad_s, period_s)
                for source, residual in self.residuals.items()
            },
            table=self._rows,
            ratios=np.full((len(self._rows), *speed_rad_s.shape), np.nan),
            at_rest=samples.idle & self._judges_rest,
            scored={source: [] for source in RESIDUALS},
            scores=scores,
        )
        detect(self._detectors_of["tacho"], piece.given(samples.alive), piece.ratios)
        return piece

    def _complete(self, piece: Piece) -> None:
        scored: dict[Signal, JoinedResidual] = {
            source: self.residuals[source].joined(parts) for source, parts in piece.scored.items()
        }
        smoothed: dict[Signal, Array] = {
            source: self.residuals[source].smooth(of, piece.period_s) for source, of in scored.items()
        }
        piece.complete(scored, smoothed, self._intervals.in_use, self.limits.timing.baseline_s)
        if self._observations is not None:
            self._observations.append(piece.observation(scored))

    def snapshot(self) -> dict[str, Any]:
        """The state as JSON can hold it."""
        return {
            "origin_t_ns": self.origin_t_ns,
            **self._intervals.snapshot(),
            "motion": self._motion.snapshot(),
            "healthy_motion": self._healthy_motion.snapshot(),
            "movement": self._movement.snapshot(),
            "gaps": self._gaps.snapshot(),
            "detectors": {name: detector.snapshot() for name, detector in self.detectors.items()},
            **{source: residual.snapshot() for source, residual in self.residuals.items()},
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        """Continue from a snapshot for as many fans; if this raises, nothing has changed.

        Raises:
            ValueError, KeyError, TypeError: it is no snapshot of a FanScorer.
        """
        before = self.snapshot()
        try:
            self._restore(state)
        except (ValueError, LookupError, TypeError, AttributeError, OverflowError):
            self._restore(before)
            raise

    def _restore(self, state: Mapping[str, Any]) -> None:
        self._intervals.restore(state)
        self._motion.restore(state["motion"])
        self._healthy_motion.restore(state["healthy_motion"])
        self._movement.restore(state["movement"])
        self._gaps.restore(state["gaps"])
        for source, residual in self.residuals.items():
            residual.restore(state[source])
        for name, detector in self.detectors.items():
            detector.restore(state["detectors"][name])
        origin_t_ns = state["origin_t_ns"]
        self.origin_t_ns = None if origin_t_ns is None else int(origin_t_ns)


def _parts(ends: Array) -> Iterator[tuple[int, int]]:
    """The first row of each part and the one after its last; ends: (n - 1,) whether a part ends after a row."""
    edges = [0, *(np.flatnonzero(ends) + 1).tolist(), len(ends) + 1]
    return pairwise(edges)
