"""Training of the NARX network: from the best linear filter to as much curvature as improves the fit of unseen speeds.

Fitting each next sample from measured ones (series-parallel, the published way) is biased by the noise in its own
regressors, and a small one-step error does not imply a good free run. So the free run itself is fitted (parallel
training: Narendra and Parthasarathy, IEEE Transactions on Neural Networks 1, 1990):

1. The start is a layer that acts as the best first-order filter of the data (`starting_weights`).
2. A prior ties its 1151 weights to the start, those of old samples more strongly than those of recent ones. The prior
   is strong at first and relaxed by a factor of ten at a time, each fit starting from the previous one
   (twin.fitting.narx_fit).
3. Each precision of the prior is evaluated by the free run over speeds that were not fitted: those of the held-out
   runs; if none are given, those of whole runs left out in turn; for a single run, those of blocks left out. Relaxing
   ends when it no longer helps.
4. All speeds of the training runs are fitted at the chosen precision, or at the next stronger one whose free run
   forgets its start (twin.fitting.narx_fit); if none does, at the strongest.

The cost of a fit is proportional to its samples: from long recordings, stretches of MAX_SAMPLES in total are drawn at
random.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fantwin.twin.errors import TwinError
from fantwin.twin.evaluation.accuracy import evaluation_pieces, free_run_residuals, pooled_rmse_rad_s
from fantwin.twin.fitting.narx_fit import LAG_SCALE, OutputErrorFit, forgets_its_start
from fantwin.twin.models.narx import INPUTS, ORDER, UNITS, Narx, regressor_rows
from fantwin.twin.models.network import Scaling
from fantwin.twin.models.physics import PARAMETER_NAMES
from fantwin.twin.models.recursion import linear_recursion
from fantwin.twin.progress import Progress, unreported
from fantwin.twin.runs import STARTING_SAMPLES, Array, Run

TIME_CONSTANTS_SAMPLES = np.geomspace(0.5, 2000.0, 40)
# Standard deviation of a unit's input when all its regressors have standard deviation one.
UNIT_SLOPE = 0.2
# Regressors of a linear filter lie in a plane. Scatter around it makes the layer linear off the plane as well.
SCATTER = 0.1
MAX_ROWS = 4000


def starting_weights(
    commands: Sequence[Array], speeds: Sequence[Array], rng: np.random.Generator
) -> tuple[Array, float]:
    """theta (1151,) of a layer that acts as a first-order filter, and the filter's time constant in samples.

    Small random weights keep each unit on the nearly straight part of its tanh, so the layer starts close to a linear
    model whose free run is stable and near the data; training adds the curvature. The filter is fitted by output error
    on a grid of time constants: with the time constant given, gain and offset are linear in the data, so noise on the
    speeds biases nothing, and missing ones are left out.

    commands, speeds: one (n,) each a stretch, scaled; a speed of NaN is missing.
    """
    linear, smooth = first_order_filter(commands, speeds)
    regressors = np.concatenate([regressor_rows(*pair) for pair in zip(smooth, commands, strict=True)])
    regressors = rng.choice(regressors, min(len(regressors), MAX_ROWS), replace=False)
    regressors = regressors + rng.normal(scale=SCATTER, size=regressors.shape)
    input_weights = rng.normal(size=(INPUTS, UNITS)) * LAG_SCALE[: INPUTS * UNITS].reshape(INPUTS, UNITS)
    input_weights *= UNIT_SLOPE / np.linalg.norm(input_weights, axis=0).mean()
    bias = rng.uniform(-1.0, 1.0, UNITS)
    layer = np.column_stack((np.tanh(regressors @ input_weights + bias), np.ones(len(regressors))))
    squares = layer.T @ layer
    ridge = 1e-6 * np.trace(squares) / len(squares) * np.eye(len(squares))
    output = np.linalg.solve(squares + ridge, layer.T @ (regressors @ linear[:-1] + linear[-1]))
    return np.concatenate((input_weights.ravel(), bias, output)), float(-1.0 / np.log(linear[0]))


def first_order_filter(commands: Sequence[Array], speeds: Sequence[Array]) -> tuple[Array, list[Array]]:
    """The best low-pass filter from command to speed: coefficients (22,) of the 21 regressors and 1, and its speeds."""
    measured = np.concatenate(speeds)
    known = np.isfinite(measured)
    candidates = []
    for time_constant in TIME_CONSTANTS_SAMPLES:
        kept = float(np.exp(-1.0 / time_constant))
        smooth = np.concatenate([_low_pass(command, kept) for command in commands])
        columns = np.column_stack((smooth, np.ones(len(smooth))))
        gain_and_offset = np.linalg.lstsq(columns[known], measured[known])[0]
        error = float(np.sum((measured - columns @ gain_and_offset)[known] ** 2))
        candidates.append((error, kept, gain_and_offset))
    _, kept, (gain, offset) = min(candidates, key=lambda candidate: candidate[0])
    linear = np.zeros(INPUTS + 1)
    linear[0], linear[ORDER], linear[-1] = kept, (1.0 - kept) * gain, (1.0 - kept) * offset
    return linear, [gain * _low_pass(command, kept) + offset for command in commands]


def _low_pass(command: Array, kept: float) -> Array:
    """x[k+1] = kept x[k] + (1 - kept) command[k], at rest at the first command."""
    forcing = np.append(0.0, (1.0 - kept) * (command[:-1] - command[0]))
    return command[0] + linear_recursion(np.full((len(command) - 1, 1), kept), forcing[:, np.newaxis])[:, 0]


MAX_ITERATIONS = 100
MAX_SAMPLES, DRAWN_STRETCHES = 16_000, 16
PRIOR_PRECISIONS = (1e5, 1e4, 1e3, 1e2, 1e1, 1e0)
# A weaker prior must lower the error by this share: less is chance, and a strong one is safer on new commands.
NEEDED_GAIN = 0.002
ITERATIONS_A_PRECISION = 20
# Of all iterations; the rest are for the fit at the precision chosen.
CHOOSING_SHARE = 0.6
FOLDS = 3
BLOCKS, LEFT_OUT_EVERY = 20, 4


def train_narx(
    runs: Sequence[Run],
    validation_runs: Sequence[Run],
    scaling: Scaling,
    *,
    seed: int,
    max_iterations: int,
    progress: Progress = unreported,
) -> tuple[Narx, int]:
    """The trained network and the iterations taken. validation_runs: held out of the fit, they choose the prior.

    Raises TwinError when no stretch of the runs holds two measured speeds.
    """
    rng = np.random.default_rng(seed)
    pieces = evaluation_pieces(runs)
    stretches = draw_stretches(pieces, rng)
    start, time_constant = starting_weights(
        [(stretch.command[:, 0] - scaling.command_offset) / scaling.command_scale for stretch in stretches],
        [(stretch.speed_rad_s[:, 0] - scaling.speed_offset_rad_s) / scaling.speed_scale_rad_s for stretch in stretches],
        rng,
    )
    count = _Count(max_iterations, progress)
    parted = [(pieces, evaluation_pieces(validation_runs))] if validation_runs else leave_out(runs)
    folds = [_Fold(*parts, start, scaling, rng) for parts in parted]
    chosen = _relax_prior(folds, count, round(CHOOSING_SHARE * max_iterations))
    whole = OutputErrorFit(stretches, scaling, start)
    model = Narx(start, scaling)
    for precision, theta in reversed(chosen):
        limit = min(max_iterations - count.iterations, ITERATIONS_A_PRECISION)
        model = Narx(whole.minimise(theta, precision, limit, count.iteration_done), scaling)
        if forgets_its_start(model, time_constant):
            break
    return model, count.iterations


def draw_stretches(pieces: Sequence[Run], rng: np.random.Generator) -> list[Run]:
    """Runs of one fan each: all of them, or random parts of MAX_SAMPLES in all. Raises TwinError when nothing is left.

    Parts start from their first measured speeds, as a deployed twin does.
    """
    single = [piece.fan(index) for piece in pieces for index in range(piece.fans)]
    if sum(run.samples for run in single) > MAX_SAMPLES:
        samples = MAX_SAMPLES // DRAWN_STRETCHES
        single = [run.rows(first, last) for run in single for first, last in run.equal_parts(samples)]
        single = [single[index] for index in rng.permutation(len(single))]
    usable = [run for run in single if np.isfinite(run.speed_rad_s).sum() >= 2]
    if not usable:
        raise TwinError("no stretch of the runs holds two measured speeds; NARX has nothing to learn from")
    room = np.cumsum([run.samples for run in usable]) <= MAX_SAMPLES
    return [run for run, fits in zip(usable, room, strict=True) if fits]


def leave_out(runs: Sequence[Run]) -> list[tuple[list[Run], list[Run]]]:
    """Pieces to fit and to evaluate on: up to three folds of whole runs, or blocks of a single one."""
    folds = min(len(runs), FOLDS)
    if folds == 1:
        return [leave_out_blocks(evaluation_pieces(runs))]
    return [
        (
            evaluation_pieces([run for index, run in enumerate(runs) if index % folds != fold]),
            evaluation_pieces([run for index, run in enumerate(runs) if index % folds == fold]),
        )
        for fold in range(folds)
    ]


def leave_out_blocks(pieces: Sequence[Run]) -> tuple[list[Run], list[Run]]:
    """The pieces twice: without the speeds of every fourth of twenty blocks, and with those alone.

    The commands stay, so both are free runs over the whole. The second keeps the speeds that a free run starts from.
    """
    kept, left_out = [], []
    for piece in pieces:
        count = np.cumsum(np.isfinite(piece.speed_rad_s), axis=0)
        block = (count - 1) * BLOCKS // np.maximum(count[-1], 1)
        out = block % LEFT_OUT_EVERY == LEFT_OUT_EVERY // 2
        kept.append(replace(piece, speed_rad_s=np.where(out, np.nan, piece.speed_rad_s)))
        judged = out | (count <= STARTING_SAMPLES)
        left_out.append(replace(piece, speed_rad_s=np.where(judged, piece.speed_rad_s, np.nan)))
    return kept, left_out


class _Fold:
    """A fit to some speeds, evaluated on others."""

    def __init__(
        self, fitted: Sequence[Run], judged: Sequence[Run], start: Array, scaling: Scaling, rng: np.random.Generator
    ) -> None:
        self.fit = OutputErrorFit(draw_stretches(fitted, rng), scaling, start)
        self.judged = judged
        self.theta = start

    def residual(self) -> Array:
        """(m,) measured minus free run, in rad/s, of the evaluated speeds."""
        unused = np.ones((self.judged[0].fans, len(PARAMETER_NAMES)))
        return free_run_residuals(Narx(self.theta, self.fit.scaling), unused, self.judged).ravel()


@dataclass
class _Count:
    """Counts the iterations of all fits together."""

    max_iterations: int
    progress: Progress
    iterations: int = 0

    def iteration_done(self, rmse_rad_s: float) -> None:
        """See narx_fit.IterationDone."""
        self.iterations += 1
        self.progress("training", self.iterations, self.max_iterations, rmse_rad_s)


def _relax_prior(folds: Sequence[_Fold], count: _Count, max_iterations: int) -> list[tuple[float, Array]]:
    """Precisions of the prior, from the strongest to the best one, each with the weights (1151,) of the first fold.

    Fits at one precision after the other, until one gives no improvement.
    """
    better: list[tuple[float, Array]] = []
    best_rmse_rad_s = np.inf
    for precision in PRIOR_PRECISIONS:
        for index, fold in enumerate(folds):
            share = (max_iterations - count.iterations) // (len(folds) - index)
            fold.theta = fold.fit.minimise(
                fold.theta, precision, min(share, ITERATIONS_A_PRECISION), count.iteration_done
            )
        rmse_rad_s = pooled_rmse_rad_s(np.concatenate([fold.residual() for fold in folds]))
        if rmse_rad_s >= (1.0 - NEEDED_GAIN) * best_rmse_rad_s:
            break
        better.append((precision, folds[0].theta))
        best_rmse_rad_s = rmse_rad_s
    return better
