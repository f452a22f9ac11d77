"""Training of the network of a neural ODE or hybrid on the free-run error.

The published recipe is Adam on the mean absolute error (twin.fitting.torch_reference). This one needs tens of
iterations instead of thousands, because the model is small enough for second-order steps with exact sensitivities:

1. A few starts from twin.fitting.initial_weights, each taken some steps of Levenberg-Marquardt over stretches of a few
   time constants, each stretch with its own initial speed (multiple shooting). The best one goes on.
2. The same until it no longer improves.
3. The free run itself, over stretches as long as practical, from their measured speeds.

The readings of many fans are thinned for all this (twin.fitting.trajectories), and the last iterations use all of them.

Where several networks are asked for, as many of the best starts go on, each by itself, and the model is the mean of
those that end about as well as the best (twin.fitting.mean_of_networks): then hardly anything depends on the seed.

Every iterate is evaluated as it would be used: by its free run from the measured start, over the held-out runs, or over
the training runs where none are given. The best one is kept. The untrained network (all weights zero: for a hybrid, its
physics) is a candidate. Training stops when held-out runs no longer improve.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from fantwin.twin.evaluation.accuracy import evaluation_pieces
from fantwin.twin.fitting.free_run_fit import FreeRunFit, fit_free_run
from fantwin.twin.fitting.free_run_problem import FreeRunProblem, NetworkPrior, Point, Prior, Unknowns
from fantwin.twin.fitting.identification import Identification, inertia_anchor
from fantwin.twin.fitting.initial_weights import PLACEMENTS, initial_weights
from fantwin.twin.fitting.mean_of_networks import mean_model
from fantwin.twin.fitting.reading_errors import counts, robust_scale
from fantwin.twin.fitting.trajectories import (
    MAX_SAMPLES,
    Trajectories,
    cut_into_trajectories,
    practical_samples,
    stretch_samples,
    thinning_factor,
    windows_of,
)
from fantwin.twin.models.fan_ode import NetworkOde
from fantwin.twin.models.integration import WIDE_BATCH
from fantwin.twin.models.network import Scaling
from fantwin.twin.models.physical import PhysicalModel, fitted_unknowns, physical_parameters
from fantwin.twin.models.physics import LAG
from fantwin.twin.network_training import ForEachNetwork, one_after_another
from fantwin.twin.progress import Progress, unreported
from fantwin.twin.runs import Array, Run

MAX_ITERATIONS = 120
SHORT_STRETCH_TIME_CONSTANTS = 10.0
STARTS_OF_NETWORK, START_ITERATIONS, START_SAMPLES = 4, 5, 30_000
MOST_NETWORKS = PLACEMENTS // STARTS_OF_NETWORK
SHORT_SHARE = 0.75
LAST_STEPS, LAST_ITERATIONS = 4, 20  # of many fans, on all samples; a step that is rejected costs little
TOLERANCE = 1e-4
MUCH_WORSE = 2.0
"""a fit to all samples whose free run over the windows has a larger loss, relative to that before, is not kept: the
initial speeds of its stretches may have hidden an instability"""
ABOUT_AS_WELL = 1.03
"""a network whose free run has a larger loss, relative to that of the best one, is left out of the mean"""
MAX_STALLED_ITERATIONS = 10
# Weights have a prior standard deviation of ten in scaled units: too wide to matter where there are data.
PRIOR_PRECISION = 0.01
# Each point of the grid counts as one observation of the acceleration with this standard deviation, in its scale.
GRID_POINTS, GRID_REACH, GRID_PRIOR_STD = 15, 1.5, 0.1


def data_scaling(runs: Sequence[Run], identification: Identification) -> Scaling:
    """Offsets and scales from the ranges in the data; the acceleration scale is half the range per time constant."""
    speeds = np.concatenate([run.speed_rad_s[np.isfinite(run.speed_rad_s)] for run in runs])
    commands = np.concatenate([run.command.ravel() for run in runs])
    speed_scale = 0.5 * float(np.ptp(speeds))
    return Scaling(
        speed_offset_rad_s=float(speeds.min()) + speed_scale,
        speed_scale_rad_s=speed_scale,
        command_offset=0.5 * float(commands.min() + commands.max()),
        command_scale=0.5 * float(np.ptp(commands)),
        acceleration_scale_rad_s2=speed_scale / float(np.median(identification.time_constant_s)),
    )


def train_network(
    model: NetworkOde,
    runs: Sequence[Run],
    validation_runs: Sequence[Run],
    identification: Identification,
    *,
    max_iterations: int,
    seed: int = 0,
    prior_std: float = GRID_PRIOR_STD,
    networks: int = 1,
    each: ForEachNetwork = one_after_another,
    progress: Progress = unreported,
) -> tuple[NetworkOde, Array, int]:
    """Train the model's network. Returns the trained model, the parameters (fans, 4) and the iterations taken.

    J, alpha, C_D and the lag of each fan are fitted along with the network (with a counting tacho, alpha and C_D only).
    max_iterations: of each network; those of the starts come before and are not counted, the few on all samples of many
    fans come on top. prior_std: how far the network's acceleration may be from the physics where there are no data, in
    units of its scale (twin.fitting.cross_validation chooses it). Zero: the weights stay zero.
    networks: how many are trained; the model is the mean of those that end about as well as the best. each: runs
    their trainings.
    """
    if prior_std == 0.0:
        return model.with_theta(np.zeros_like(model.network.theta)), identification.parameters, 0
    training = _Training(model, runs, validation_runs, identification, prior_std)
    starts = training.starts(np.random.default_rng(seed), STARTS_OF_NETWORK * networks, progress)
    trained = each(partial(training.continued, max_iterations), starts[:networks], "training", progress)
    least = min(one.best_loss for one in trained)
    kept = [one for one in trained if one.best_loss <= ABOUT_AS_WELL * least]
    found, iterations = [one.best for one in kept], sum(one.iterations for one in trained)
    if training.is_thinned:
        last = each(training.on_all_samples, kept, "training on all samples", progress)
        found, iterations = [unknowns for unknowns, _ in last], iterations + sum(count for _, count in last)
    return *mean_model([training.model_of(unknowns) for unknowns in found]), iterations


@dataclass(frozen=True, eq=False)
class _Trained:
    """The unknowns with the best free run of a training, its loss, and the iterations that it took."""

    best: Unknowns
    best_loss: float
    iterations: int


class _Training:
    """What all trainings of a model have in common: the data, the priors, and how long stretches are."""

    def __init__(
        self,
        model: NetworkOde,
        runs: Sequence[Run],
        validation_runs: Sequence[Run],
        identification: Identification,
        prior_std: float,
    ) -> None:
        slowest_s = float(identification.time_constant_s.max())
        self.model = model
        self._all_pieces = evaluation_pieces(runs)
        factor = thinning_factor(self._all_pieces, slowest_s)
        self._pieces, self.is_thinned = windows_of(self._all_pieces, slowest_s), factor > 1
        self.held_out = bool(validation_runs)
        self.judged = windows_of(evaluation_pieces(validation_runs), slowest_s) if validation_runs else self._pieces
        self._identification = identification
        self.top_speed_rad_s = identification.top_speed_rad_s
        period_s = min(piece.median_period_s for piece in self._pieces)
        self._short = stretch_samples(slowest_s, period_s, SHORT_STRETCH_TIME_CONSTANTS)
        self._stretches = cut_into_trajectories(self._pieces, self._short)
        self.physics = fitted_unknowns(identification.parameters, self.top_speed_rad_s)
        self._free = np.ones(self.physics.shape, np.bool_)
        # A lag that identification has not found stays out of the model.
        self._free[:, LAG] &= identification.parameters[:, LAG] > 0.0
        pull = inertia_anchor(sum(piece.samples for piece in self._pieces) / factor)
        self._prior = Prior(PRIOR_PRECISION, pull, self.physics, _network_prior(model, identification, prior_std))

    def starts(self, rng: np.random.Generator, count: int, progress: Progress) -> list[Unknowns]:
        """So many of them, each after a few steps with the physics as identified, best first."""
        few = self._stretches.thinned(START_SAMPLES)
        fits: list[FreeRunFit] = []

        def iteration_done(iteration: int, _unknowns: Unknowns, rmse_rad_s: float) -> bool:
            done = START_ITERATIONS * len(fits) + iteration
            progress("starting weights", done, START_ITERATIONS * count, rmse_rad_s)
            return False

        for theta in initial_weights(self.model, self._pieces, self._identification, rng, count):
            problem = replace(self._problem(theta, few), free=np.zeros_like(self._free))
            fits.append(
                fit_free_run(problem, self.physics, max_iterations=START_ITERATIONS, iteration_done=iteration_done)
            )
        ranked = sorted(fits, key=lambda fit: fit.rmse_rad_s if np.isfinite(fit.rmse_rad_s) else np.inf)
        return [fit.point.unknowns for fit in ranked]

    def continued(self, max_iterations: int, start: Unknowns, progress: Progress) -> _Trained:
        """A training from a start to its end."""
        best_run = _BestFreeRun(self, max_iterations, progress)
        best_run.consider(start)
        best = start
        for data, share, estimate in (
            (self._stretches, SHORT_SHARE, True),
            (cut_into_trajectories(self._pieces, practical_samples(self._pieces, MAX_SAMPLES)), 1.0, False),
        ):
            fit = fit_free_run(
                replace(self._problem(best.weights, data), estimate_initial_speed=estimate),
                best.physics,
                max_iterations=round(share * max_iterations) - best_run.iterations,
                tolerance=TOLERANCE,
                with_errors=True,
                iteration_done=best_run.iteration_done,
            )
            best_run.stage_done(fit.iterations)
            best = best_run.best
        return _Trained(best_run.best, best_run.best_loss, best_run.iterations)

    def model_of(self, unknowns: Unknowns) -> tuple[NetworkOde, Array]:
        """The model of these unknowns, and the parameters (fans, 4)."""
        return self.model.with_theta(unknowns.weights), physical_parameters(unknowns.physics, self.top_speed_rad_s)

    def on_all_samples(self, trained: _Trained, progress: Progress) -> tuple[Unknowns, int]:
        """The last iterations of a training on windows, and their number; none where its network stayed silent.

        Windows say little of the physics of each fan. Their result is kept unless its free run is much worse: free runs
        over the windows speak for what was fitted to them.
        """
        best = trained.best
        if not np.any(best.weights):
            return best, 0
        steps = itertools.count(1)

        def iteration_done(_iteration: int, _unknowns: Unknowns, rmse_rad_s: float) -> bool:
            step = next(steps)
            progress("training on all samples", step, LAST_STEPS, rmse_rad_s)
            return step == LAST_STEPS

        pull = inertia_anchor(sum(piece.samples for piece in self._all_pieces))
        problem = self._problem(best.weights, cut_into_trajectories(self._all_pieces, self._short))
        problem.prior = replace(self._prior, physics=pull, limits_steps=True)
        fit = fit_free_run(
            problem,
            best.physics,
            max_iterations=LAST_ITERATIONS,
            tolerance=TOLERANCE,
            with_errors=True,
            iteration_done=iteration_done,
        )
        found = fit.point.unknowns
        loss = _BestFreeRun(self, 0, progress).loss_of(found)
        return found if loss <= MUCH_WORSE * trained.best_loss else best, fit.iterations

    def _problem(self, weights: Array, data: Trajectories) -> FreeRunProblem:
        return FreeRunProblem(self.model.with_theta(weights), data, self.top_speed_rad_s, self._free, self._prior)


def _network_prior(model: NetworkOde, identification: Identification, prior_std: float) -> NetworkPrior:
    """Where there are no data, the model is the mean fan's physics: on a grid over and around the recorded ranges."""
    scale = model.network.scaling
    side = np.linspace(-GRID_REACH, GRID_REACH, GRID_POINTS)
    speed, command = (values.ravel() for values in np.meshgrid(side, side))
    speed_rad_s = scale.speed_offset_rad_s + scale.speed_scale_rad_s * speed
    commands = scale.command_offset + scale.command_scale * command
    mean_fan = identification.parameters.mean(axis=0, keepdims=True)
    untrained = model.with_theta(np.zeros_like(model.network.theta)).equation(mean_fan)
    physics = PhysicalModel().equation(mean_fan).acceleration(speed_rad_s[:, None], commands[:, None])
    known = untrained.acceleration(speed_rad_s[:, None], commands[:, None])
    weight = (prior_std * scale.acceleration_scale_rad_s2) ** -2
    return NetworkPrior(speed_rad_s, commands, (physics - known)[:, 0], weight)


class _BestFreeRun:
    """Keeps the unknowns with the best free run, and stops the fit when held-out runs no longer improve."""

    def __init__(self, training: _Training, max_iterations: int, progress: Progress) -> None:
        pieces, top_speed_rad_s = training.judged, training.top_speed_rad_s
        whole = max(piece.samples for piece in pieces)
        self.data = cut_into_trajectories(pieces, practical_samples(pieces, whole))
        self.problem = self.beginning = FreeRunProblem(training.model, self.data, top_speed_rad_s)
        if len(self.data.fan) >= WIDE_BATCH:
            rows = int(np.flatnonzero(self.data.early.any(axis=1)).max(initial=0)) + 1
            self.beginning = FreeRunProblem(training.model, self.data.first_samples(rows), top_speed_rad_s)
        self.held_out, self.max_iterations, self.progress = training.held_out, max_iterations, progress
        self.iterations = self.stalled_iterations = 0
        self.guess_rad_s = self.data.interpolated_speed_rad_s()
        untrained = Unknowns(np.zeros_like(training.model.theta), training.physics, np.zeros(0))
        if counts(self.data):
            # By the physics: an untrained network without them says nothing of how the speed changes.
            physical = FreeRunProblem(PhysicalModel(), self.data, top_speed_rad_s)
            physical.learn_errors(physical.point(np.zeros(0), untrained.physics))
            self.problem.errors = physical.errors
        self.problem.scale_rad_s = robust_scale(self._free_run(untrained).residual, self.data)
        self.best, self.best_loss = untrained, self.loss_of(untrained)

    def consider(self, unknowns: Unknowns) -> None:
        """Keep these unknowns if the robust loss of their free run from the measured start is the smallest so far."""
        loss = self.loss_of(unknowns)
        if loss < self.best_loss:
            self.best, self.best_loss, self.stalled_iterations = unknowns, loss, 0
        else:
            self.stalled_iterations += 1

    def loss_of(self, unknowns: Unknowns) -> float:
        """The robust loss of the free run from the measured start; NaN or infinite where it diverges."""
        return float(self._free_run(unknowns).cost.sum())

    def iteration_done(self, iteration: int, unknowns: Unknowns, rmse_rad_s: float) -> bool:
        """See free_run_fit.IterationDone."""
        self.progress("training", self.iterations + iteration, self.max_iterations, rmse_rad_s)
        self.consider(unknowns)
        return self.held_out and self.stalled_iterations >= MAX_STALLED_ITERATIONS

    def stage_done(self, iterations: int) -> None:
        """Count the iterations of a stage; the next one starts with none stalled."""
        self.iterations += iterations
        self.stalled_iterations = 0

    def _free_run(self, unknowns: Unknowns) -> Point:
        """From the speeds whose free runs are nearest to the first measured ones, as in twin.evaluation.accuracy."""
        started = Unknowns(unknowns.weights, unknowns.physics, self.data.starting_speed_rad_s())
        begun, rows = self.beginning.trajectories, slice(len(self.beginning.trajectories.command))
        first_rad_s = self.beginning.evaluate(started, self.guess_rad_s[rows]).speed_rad_s
        early = self.data.early[rows]
        residual = begun.speed_rad_s - begun.measurement.of_speed(first_rad_s)
        missed = np.sum(residual, axis=0, where=early) / early.sum(axis=0)
        nearer = started.initial_speed_rad_s + np.where(np.isfinite(missed), missed, 0.0)
        guess_rad_s = first_rad_s if self.beginning is self.problem else self.guess_rad_s
        return self.problem.evaluate(replace(started, initial_speed_rad_s=nearer), guess_rad_s)
