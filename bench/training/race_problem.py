"""What the training race is about: one run, one hybrid, and an evaluation whose own time does not count.

All racers train the same 41 weights, in the layout of twin.models.network. Whoever fits by gradient gets the run cut
into
stretches side by side, each with an initial speed of its own to be learned: far quicker to fit than one long run.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field

import numpy as np

from fantwin.twin.evaluation.accuracy import evaluation_pieces, free_run_residuals, pooled_rmse_rad_s
from fantwin.twin.fitting.identification import Identification
from fantwin.twin.fitting.initial_weights import initial_weights
from fantwin.twin.fitting.training import data_scaling
from fantwin.twin.models.hybrid import UNITS, Hybrid
from fantwin.twin.models.lag import effective_command
from fantwin.twin.models.network import TanhNetwork
from fantwin.twin.models.physics import LAG
from fantwin.twin.runs import Array, Run

EVALUATION_PERIOD_S = 1.0


@dataclass(frozen=True, eq=False)
class Problem:
    """A run of one fan to fit. model: a hybrid with the weights to start from; identification: its physics, fixed."""

    run: Run
    identification: Identification
    model: Hybrid

    @property
    def step_s(self) -> float:
        """Time between samples."""
        return self.run.median_period_s

    def stretches(self, samples: int) -> tuple[Array, Array]:
        """Commands and measured speeds (samples, batch), one after the other; a rest at the end is left out."""
        lag_s = self.identification.parameters[:, LAG]
        # The lag comes before the motion and has no weights: everybody gets the command as it acts.
        acting, _ = effective_command(self.run.command, self.run.step_s[:, np.newaxis], lag_s, self.run.command[0])
        whole = self.run.samples // samples * samples
        command, speed = (values[:whole, 0].reshape(-1, samples).T for values in (acting, self.run.speed_rad_s))
        return command.copy(), speed.copy()


def problem(run: Run, identification: Identification, *, placed: bool, seed: int) -> Problem:
    """A hybrid on [w, tau] before training.

    placed: start from our weights (twin.fitting.initial_weights, least squares), otherwise as neural networks usually
    do: random hidden units, and no output yet.
    """
    rng = np.random.default_rng(seed)
    untrained = Hybrid(TanhNetwork.zero(UNITS, ("speed", "command"), data_scaling([run], identification)))
    if placed:
        (start,) = initial_weights(untrained, [run], identification, rng, keep=1)
        return Problem(run, identification, untrained.with_theta(start))
    hidden = rng.normal(size=3 * UNITS)
    return Problem(run, identification, untrained.with_theta(np.concatenate((hidden, np.zeros(UNITS + 1)))))


@dataclass(frozen=True)
class Phase:
    """A part of somebody's training, until a share of the time given has gone. stretch: its length in samples."""

    stretch: int
    learning_rate: float
    until_share: float = 1.0


@dataclass
class TimedEvaluation:
    """Runs weights freely over the whole run, as they would serve, and keeps the best. Its own time does not count.

    floor_rad_s: the error of a perfect model. A racer calls `start` when its preparations (compiling, say) are over,
    `pause` before more of them, and `finished` with its present weights whenever `due`.
    """

    problem: Problem
    floor_rad_s: float
    target: float
    limit_s: float
    best: float = np.inf
    """smallest error so far, in multiples of the floor"""
    best_after_s: float = 0.0
    reached_after_s: float | None = None
    iterations: int = 0
    _shown_s: float = 0.0
    _started_s: float = field(default_factory=time.perf_counter)
    _evaluated_s: float = -np.inf

    def start(self) -> None:
        """The stopwatch runs on from what it showed last."""
        self._started_s = time.perf_counter() - self._shown_s

    def pause(self) -> None:
        """The stopwatch stands until the next start."""
        self._shown_s = self.spent_s

    @property
    def spent_s(self) -> float:
        """Seconds since the start of the running stopwatch."""
        return time.perf_counter() - self._started_s

    def due(self) -> bool:
        """Whether it is time to show weights again. Counts an iteration."""
        self.iterations += 1
        return self.spent_s - self._evaluated_s > EVALUATION_PERIOD_S

    def finished(self, theta: Array) -> bool:
        """Evaluate weights (41,); true when the target is reached or the time is up."""
        now_s = self.spent_s
        model = self.problem.model.with_theta(np.asarray(theta, dtype=np.float64))
        pieces = evaluation_pieces([self.problem.run])
        error = pooled_rmse_rad_s(free_run_residuals(model, self.problem.identification.parameters, pieces))
        error /= self.floor_rad_s
        if error < self.best:
            self.best, self.best_after_s = error, now_s
        if self.reached_after_s is None and error <= self.target:
            self.reached_after_s = now_s
        self._started_s += self.spent_s - now_s
        self._evaluated_s = now_s
        return self.reached_after_s is not None or now_s > self.limit_s
