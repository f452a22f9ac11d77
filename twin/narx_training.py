"""Training of the NARX network: series-parallel, by Levenberg-Marquardt with regularisation.

Series-parallel means that each row predicts one sample from measured ones; the free run, where predictions feed back,
is only what comes of it. That is the published way, and the reason why a good one-step error promises little.
Rows beyond MAX_ROWS are drawn at random: 1151 weights do not need more, and the normal equations cost by the row.
"""

from collections.abc import Sequence

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from twin.errors import TwinError
from twin.evaluation import evaluation_pieces, free_run_residuals, pooled_rmse_rad_s
from twin.narx import INPUTS, ORDER, UNITS, Narx
from twin.network import Scaling
from twin.runs import Array, Run
from twin.training import Progress

MAX_ROWS = 6000
# Relative to a residual of order of the noise: strong enough to damp directions that no row sees.
PRIOR_PRECISION = 1e-4
SMALLEST_DAMPING, LARGEST_DAMPING = 1e-9, 1e9


def train_narx(
    runs: Sequence[Run],
    validation_runs: Sequence[Run],
    scaling: Scaling,
    *,
    seed: int,
    max_iterations: int,
    progress: Progress | None = None,
) -> tuple[Narx, int]:
    """The trained network and the iterations taken. With held-out runs the best of all iterates on their free run.

    Raises TwinError when no stretch of measured speeds is longer than the ten past samples.
    """
    rng = np.random.default_rng(seed)
    pieces = evaluation_pieces(runs)
    inputs, target = _rows(pieces, scaling, rng)
    held_out = evaluation_pieces(validation_runs) if validation_runs else []
    fans = pieces[0].fans
    theta = _random_weights(rng)
    cost, best, best_error = _cost(theta, inputs, target), theta, np.inf
    damping, iteration = 1e-2, 0
    for iteration in range(1, max_iterations + 1):
        jacobian, residual = _jacobian(theta, inputs, target)
        squares = jacobian.T @ jacobian
        downhill = jacobian.T @ residual - PRIOR_PRECISION * len(target) * theta
        diagonal = np.diag(squares).copy()
        previous = cost
        while damping < LARGEST_DAMPING:
            ridge = damping * diagonal + PRIOR_PRECISION * len(target)
            factor = cho_factor(squares + np.diag(ridge), lower=True, check_finite=False)
            trial = theta + cho_solve(factor, downhill, check_finite=False)
            trial_cost = _cost(trial, inputs, target)
            if trial_cost < cost:
                theta, cost, damping = trial, trial_cost, max(damping / 5.0, SMALLEST_DAMPING)
                break
            damping *= 4.0
        error = _free_run_error(Narx(theta, scaling), held_out, fans) if held_out else cost
        if error < best_error:
            best, best_error = theta, error
        if progress is not None:
            progress(iteration, max_iterations, scaling.speed_scale_rad_s * float(np.sqrt(np.mean(residual**2))))
        if previous - cost < 1e-4 * previous:
            break
    return Narx(best, scaling), iteration


def _rows(pieces: Sequence[Run], scaling: Scaling, rng: np.random.Generator) -> tuple[Array, Array]:
    """Scaled regressors (rows, 21) and next speeds (rows,), all of them measured, of all fans."""
    blocks = []
    for piece in pieces:
        speed = (piece.speed_rad_s - scaling.speed_offset_rad_s) / scaling.speed_scale_rad_s
        command = (piece.command - scaling.command_offset) / scaling.command_scale
        present = np.arange(ORDER, piece.samples - 1)
        past = [speed[present - lag] for lag in range(ORDER)] + [command[present - lag] for lag in range(ORDER + 1)]
        blocks.append(np.stack([*past, speed[present + 1]], axis=-1).reshape(-1, INPUTS + 1))
    rows = np.concatenate(blocks)
    rows = rows[np.all(np.isfinite(rows), axis=1)]
    if not len(rows):
        raise TwinError("no stretch of eleven measured speeds in a row; NARX needs runs without so many gaps")
    if len(rows) > MAX_ROWS:
        rows = rows[rng.choice(len(rows), MAX_ROWS, replace=False)]
    return rows[:, :-1], rows[:, -1]


def _random_weights(rng: np.random.Generator) -> Array:
    hidden = rng.normal(scale=INPUTS**-0.5, size=INPUTS * UNITS)
    return np.concatenate((hidden, rng.uniform(-1.0, 1.0, UNITS), rng.normal(scale=UNITS**-0.5, size=UNITS), [0.0]))


def _hidden(theta: Array, inputs: Array) -> Array:
    rows = theta[:-1].reshape(INPUTS + 2, UNITS)
    return np.tanh(inputs @ rows[:INPUTS] + rows[INPUTS])


def _cost(theta: Array, inputs: Array, target: Array) -> float:
    residual = target - _hidden(theta, inputs) @ theta[-UNITS - 1 : -1] - theta[-1]
    return 0.5 * float(residual @ residual + PRIOR_PRECISION * len(target) * (theta @ theta))


def _jacobian(theta: Array, inputs: Array, target: Array) -> tuple[Array, Array]:
    """Derivatives of the prediction by theta (rows, 1151), and the residual (rows,)."""
    hidden = _hidden(theta, inputs)
    output_weights = theta[-UNITS - 1 : -1]
    by_bias = (1.0 - hidden * hidden) * output_weights
    by_input = (inputs[:, :, np.newaxis] * by_bias[:, np.newaxis, :]).reshape(len(inputs), -1)
    residual = target - hidden @ output_weights - theta[-1]
    return np.column_stack((by_input, by_bias, hidden, np.ones(len(inputs)))), residual


def _free_run_error(model: Narx, pieces: Sequence[Run], fans: int) -> float:
    return pooled_rmse_rad_s(free_run_residuals(model, np.ones((fans, 3)), pieces))
