"""Training of the network of a neural ODE or hybrid on the free-run error.

The published recipe is Adam on the mean absolute error (twin.torch_reference). This one needs tens of iterations
instead of hundreds, because the model is small enough for second-order steps:

1. Random tanh units placed on the data, their output weights by linear least squares through the filtering operator
   (twin.filtering): the network is one more set of regressors, so it starts near the solution.
2. Levenberg-Marquardt over stretches of a few time constants, each with its own initial speed.
3. The same over stretches as long as is practical and from their measured speeds: the free run itself.

Every iterate is judged as it would serve: by its free run from the measured start, over the held-out runs, or over the
training runs where none are given. The best one is kept, the untrained network (all weights zero: for a hybrid, its
physics) being a candidate, and training stops when held-out runs have ceased to improve.
"""

from collections.abc import Callable, Sequence

import numpy as np

from twin.evaluation import evaluation_pieces, free_run_residuals, pooled_rmse_rad_s
from twin.filtering import filtered_regression
from twin.free_run_fit import Family, fit_free_run
from twin.identification import Identification
from twin.models import NetworkOde
from twin.network import Scaling
from twin.runs import Array, Run
from twin.trajectories import MAX_SAMPLES, cut_into_trajectories, stretch_samples

Progress = Callable[[int, int, float], None]
"""Called with iterations done, iterations at most, and the present free-run rmse in rad/s."""

SHORT_STRETCH_TIME_CONSTANTS = 10.0
SHORT_SHARE = 0.6
TOLERANCE = 1e-4

PATIENCE = 10
PLACEMENTS = 12
# Weights have a prior standard deviation of ten in scaled units: wide enough to be invisible where data speak.
PRIOR_PRECISION = 0.01


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
    progress: Progress | None = None,
) -> tuple[NetworkOde, int]:
    """Train the model's network, starting from its weights; returns the trained model and the iterations taken.

    identification: the physics of the fans of the runs, which stay as they are.
    """
    pieces = evaluation_pieces(runs)
    step_s = min(piece.median_step_s for piece in pieces)
    longest_s = float(identification.time_constant_s.max())
    short = stretch_samples(longest_s, step_s, SHORT_STRETCH_TIME_CONSTANTS)
    judge = _Judge(model, runs, validation_runs, identification.parameters, max_iterations, progress)
    judge.consider(model.network.theta)
    theta = model.network.theta
    for stretch, share, estimate in ((short, SHORT_SHARE, True), (MAX_SAMPLES, 1.0, False)):
        fit = fit_free_run(
            _network_family(model, identification.parameters),
            theta[np.newaxis],
            cut_into_trajectories(pieces, stretch),
            max_iterations=round(share * max_iterations) - judge.iterations,
            prior_precision=PRIOR_PRECISION,
            tolerance=TOLERANCE,
            estimate_initial_speed=estimate,
            iteration_done=judge.iteration_done,
        )
        judge.stage_done(fit.iterations)
        theta = judge.best
    judge.consider(np.zeros_like(theta))
    return model.with_theta(judge.best), judge.iterations


def initial_weights(
    model: NetworkOde, runs: Sequence[Run], identification: Identification, rng: np.random.Generator
) -> NetworkOde:
    """Random hidden units placed on the data, and output weights by the filtering operator.

    The best of several placements: least squares is so much cheaper than training that a bad draw need not be trained.
    """
    pieces = evaluation_pieces(runs)
    candidates = [
        _fit_output_layer(_place_hidden_units(model, pieces, rng), pieces, identification) for _ in range(PLACEMENTS)
    ]
    return min(candidates, key=lambda candidate: candidate[1])[0]


def _fit_output_layer(
    placed: NetworkOde, pieces: Sequence[Run], identification: Identification
) -> tuple[NetworkOde, float]:
    """The model with its output weights fitted, and the sum of squares that is left."""
    target, regressors = _output_regression(placed, pieces, identification)
    # Random tanh units are close to collinear; the ridge keeps their weights of order one.
    squares = regressors.T @ regressors
    ridge = 1e-4 * np.trace(squares) / len(squares) * np.eye(len(squares))
    output = np.linalg.solve(squares + ridge, regressors.T @ target)
    theta = np.concatenate((placed.network.theta[: -len(output)], output))
    return placed.with_theta(theta), float(np.sum((target - regressors @ output) ** 2))


def _place_hidden_units(model: NetworkOde, pieces: Sequence[Run], rng: np.random.Generator) -> NetworkOde:
    """Hidden units of random direction and steepness, each centred on a random sample of the data."""
    network, scale = model.network, model.network.scaling
    speeds = np.concatenate([piece.speed_rad_s.ravel() for piece in pieces])
    commands = np.concatenate([piece.command.ravel() for piece in pieces])
    chosen = rng.choice(np.flatnonzero(np.isfinite(speeds)), size=network.units)
    centres = np.stack(
        (
            (speeds[chosen] - scale.speed_offset_rad_s) / scale.speed_scale_rad_s,
            (commands[chosen] - scale.command_offset) / scale.command_scale,
        )
    )[: len(network.inputs)]
    directions = rng.normal(size=centres.shape)
    slopes = directions / np.linalg.norm(directions, axis=0) * rng.uniform(0.5, 3.0, size=network.units)
    bias = -np.sum(slopes * centres, axis=0)
    return model.with_theta(np.concatenate((slopes.ravel(), bias, np.zeros(network.units + 1))))


def _output_regression(model: NetworkOde, pieces: Sequence[Run], identification: Identification) -> tuple[Array, Array]:
    """Filtered target (m,), less the known acceleration, and output-layer regressors (m, units + 1) of all fans."""
    targets, regressors = [], []
    lambda_per_s = float(np.median(identification.lambda_per_s))
    for piece in pieces:
        for fan, parameters in enumerate(identification.parameters):
            speed_rad_s, command = piece.speed_rad_s[:, fan], piece.command[:, fan]
            if np.isfinite(speed_rad_s).sum() < 2:
                continue
            basis = _output_basis(model, parameters)
            target, columns = filtered_regression(piece.t_s, speed_rad_s, command, basis, lambda_per_s)
            targets.append(target - columns[:, 0])
            regressors.append(columns[:, 1:])
    return np.concatenate(targets), np.concatenate(regressors)


def _output_basis(model: NetworkOde, parameters: Array) -> Callable[[Array, Array], Array]:
    """Speed (n,) and command (n,) to the known acceleration, each hidden unit and a constant: (n, units + 2)."""
    rate = model.network.scaling.acceleration_scale_rad_s2

    def basis(speed_rad_s: Array, command: Array) -> Array:
        known = model.known_acceleration(speed_rad_s[:, np.newaxis], command[:, np.newaxis], parameters[np.newaxis])
        hidden = model.network.hidden(speed_rad_s, command)
        return np.column_stack((known, rate * hidden, np.full(len(known), rate)))

    return basis


def _network_family(model: NetworkOde, parameters: Array) -> Family:
    return lambda theta, fan: model.with_theta(theta[0]).right_hand_side(parameters[fan])


class _Judge:
    """Keeps the weights with the best free run, and says when held-out runs have ceased to improve."""

    def __init__(
        self,
        model: NetworkOde,
        runs: Sequence[Run],
        validation_runs: Sequence[Run],
        parameters: Array,
        max_iterations: int,
        progress: Progress | None,
    ) -> None:
        self.model = model
        self.parameters = parameters
        self.pieces = evaluation_pieces(validation_runs or runs)
        self.held_out = bool(validation_runs)
        self.max_iterations = max_iterations
        self.progress = progress
        self.iterations = 0
        self.best = model.network.theta
        self.best_rmse_rad_s = np.inf
        self.worse_in_a_row = 0

    def consider(self, theta: Array) -> None:
        """Judge one set of weights (P,)."""
        residual = free_run_residuals(self.model.with_theta(theta), self.parameters, self.pieces)
        rmse_rad_s = pooled_rmse_rad_s(residual)
        if rmse_rad_s < self.best_rmse_rad_s:
            self.best, self.best_rmse_rad_s, self.worse_in_a_row = theta, rmse_rad_s, 0
        else:
            self.worse_in_a_row += 1

    def iteration_done(self, iteration: int, theta: Array, rmse_rad_s: float) -> bool:
        """See free_run_fit.IterationDone."""
        if self.progress is not None:
            self.progress(self.iterations + iteration, self.max_iterations, rmse_rad_s)
        self.consider(theta[0])
        return self.held_out and self.worse_in_a_row >= PATIENCE

    def stage_done(self, iterations: int) -> None:
        """Count a stage's iterations; the next one has its own patience."""
        self.iterations += iterations
        self.worse_in_a_row = 0
