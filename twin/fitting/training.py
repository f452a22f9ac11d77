"""Training of the network of a neural ODE or hybrid on the free-run error.

The published recipe is Adam on the mean absolute error (twin.fitting.torch_reference). This one needs tens of
iterations instead of thousands, because the model is small enough for second-order steps with exact sensitivities:

1. A few starts from twin.fitting.initial_weights, each taken some steps of Levenberg-Marquardt over stretches of a few
   time constants, each stretch with its own initial speed (multiple shooting). The best one goes on.
2. The same until it no longer improves.
3. The free run itself, over stretches as long as practical, from their measured speeds.

Every iterate is evaluated as it would be used: by its free run from the measured start, over the held-out runs, or over
the training runs where none are given. The best one is kept. The untrained network (all weights zero: for a hybrid, its
physics) is a candidate. Training stops when held-out runs no longer improve.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np

from twin.evaluation.accuracy import evaluation_pieces
from twin.fitting.free_run_fit import (
    NONE_FREE,
    FreeRunFit,
    FreeRunProblem,
    NetworkPrior,
    Point,
    Prior,
    Unknowns,
    fit_free_run,
    robust_scale,
)
from twin.fitting.identification import Identification, inertia_anchor
from twin.fitting.initial_weights import initial_weights
from twin.fitting.trajectories import MAX_SAMPLES, cut_into_trajectories, practical_samples, stretch_samples
from twin.models.model import NetworkOde
from twin.models.network import Scaling
from twin.models.physical import PhysicalModel, fitted_unknowns, physical_parameters
from twin.models.physics import LAG, PARAMETER_NAMES
from twin.progress import Progress, unreported
from twin.runs import Array, Run

Physics = Literal["fixed", "refined"]

SHORT_STRETCH_TIME_CONSTANTS = 10.0
STARTS, START_ITERATIONS, START_SAMPLES = 4, 5, 30_000
SHORT_SHARE = 0.75
TOLERANCE = 1e-4
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
    physics: Physics = "refined",
    prior_std: float = GRID_PRIOR_STD,
    progress: Progress = unreported,
) -> tuple[NetworkOde, Array, int]:
    """Train the model's network. Returns the trained model, the parameters (fans, 4) and the iterations taken.

    max_iterations: of the start that is continued; those of all starts come before and are not counted. physics:
    "refined" fits J, alpha, C_D and the lag of each fan along with the network; "fixed" leaves them as they were
    identified, as published.
    prior_std: how far the network's acceleration may be from the physics where there are no data, in units of its scale
    (twin.fitting.cross_validation chooses it). Zero: the weights stay zero.
    """
    if prior_std == 0.0:
        return model.with_theta(np.zeros_like(model.network.theta)), identification.parameters, 0
    pieces = evaluation_pieces(runs)
    period_s = min(piece.median_period_s for piece in pieces)
    short = stretch_samples(float(identification.time_constant_s.max()), period_s, SHORT_STRETCH_TIME_CONSTANTS)
    top_speed = identification.top_speed_rad_s
    start_physics = fitted_unknowns(identification.parameters, top_speed)
    free = np.full(start_physics.shape, physics == "refined")
    # A lag that identification has not found stays out of the model.
    free[:, LAG] &= identification.parameters[:, LAG] > 0.0
    pull = inertia_anchor(sum(piece.samples for piece in pieces))
    prior = Prior(PRIOR_PRECISION, pull, start_physics, _network_prior(model, identification, prior_std))
    untrained = Unknowns(np.zeros_like(model.network.theta), start_physics, np.zeros(0))
    best_run = _BestFreeRun(
        model, untrained, validation_runs or runs, bool(validation_runs), top_speed, max_iterations, progress
    )

    stretches = cut_into_trajectories(pieces, short)
    few = stretches.thinned(START_SAMPLES)
    starts: list[FreeRunFit] = []

    def start_iteration_done(iteration: int, _unknowns: Unknowns, rmse_rad_s: float) -> bool:
        progress("starting weights", START_ITERATIONS * len(starts) + iteration, STARTS * START_ITERATIONS, rmse_rad_s)
        return False

    for theta in initial_weights(model, pieces, identification, np.random.default_rng(seed), STARTS):
        fit = fit_free_run(
            model.with_theta(theta),
            start_physics,
            top_speed,
            few,
            free=np.zeros_like(free),
            prior=prior,
            max_iterations=START_ITERATIONS,
            iteration_done=start_iteration_done,
        )
        starts.append(fit)
    best = min(starts, key=lambda fit: fit.rmse_rad_s if np.isfinite(fit.rmse_rad_s) else np.inf).point.unknowns
    best_run.consider(best)
    for data, share, estimate in (
        (stretches, SHORT_SHARE, True),
        (cut_into_trajectories(pieces, practical_samples(pieces, MAX_SAMPLES)), 1.0, False),
    ):
        fit = fit_free_run(
            model.with_theta(best.weights),
            best.physics,
            top_speed,
            data,
            free=free,
            prior=prior,
            max_iterations=round(share * max_iterations) - best_run.iterations,
            tolerance=TOLERANCE,
            estimate_initial_speed=estimate,
            iteration_done=best_run.iteration_done,
        )
        best_run.stage_done(fit.iterations)
        best = best_run.best
    return model.with_theta(best.weights), physical_parameters(best.physics, top_speed), best_run.iterations


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

    def __init__(
        self,
        model: NetworkOde,
        untrained: Unknowns,
        runs: Sequence[Run],
        held_out: bool,
        top_speed_rad_s: Array,
        max_iterations: int,
        progress: Progress,
    ) -> None:
        pieces = evaluation_pieces(runs)
        whole = max(piece.samples for piece in pieces)
        self.data = cut_into_trajectories(pieces, practical_samples(pieces, whole))
        nothing = Prior(0.0, np.zeros(len(PARAMETER_NAMES)), np.zeros((len(top_speed_rad_s), len(PARAMETER_NAMES))))
        self.problem = FreeRunProblem(model, self.data, top_speed_rad_s, NONE_FREE, nothing)
        self.held_out = held_out
        self.max_iterations = max_iterations
        self.progress = progress
        self.iterations = 0
        self.guess_rad_s = self.data.interpolated_speed_rad_s()
        self.problem.scale_rad_s = robust_scale(self._free_run(untrained).residual, self.data)
        self.best, self.best_loss = untrained, float(self._free_run(untrained).cost.sum())
        self.stalled_iterations = 0

    def consider(self, unknowns: Unknowns) -> None:
        """Keep these unknowns if the robust loss of their free run from the measured start is the smallest so far."""
        loss = float(self._free_run(unknowns).cost.sum())
        if loss < self.best_loss:
            self.best, self.best_loss, self.stalled_iterations = unknowns, loss, 0
        else:
            self.stalled_iterations += 1

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
        point = self.problem.evaluate(started, self.guess_rad_s)
        early = self.data.early
        residual = self.data.speed_rad_s - self.data.measurement.of_speed(point.speed_rad_s)
        missed = np.sum(residual, axis=0, where=early) / early.sum(axis=0)
        nearer = started.initial_speed_rad_s + np.where(np.isfinite(missed), missed, 0.0)
        return self.problem.evaluate(replace(started, initial_speed_rad_s=nearer), point.speed_rad_s)
