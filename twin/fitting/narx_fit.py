"""The free run of a NARX network fitted by regularised Levenberg-Marquardt with exact sensitivities (output error).

The free run is w[k+1] = f(w[k] .. w[k-9], commands, theta), so its derivative by a weight obeys the linear recursion
S[k+1] = sum_i (df/dw[k-i]) S[k-i] + df/dtheta. All samples and all weights together are one lower triangular system of
equations with ten bands, which LAPACK solves by substitution (dtbtrs).

Residuals beyond three robust standard deviations count linearly (pseudo-Huber loss, by iteratively reweighted least
squares); missing speeds do not count.

`forgets_its_start` checks whether the free run is stable.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from fantwin.twin.fitting.damped_least_squares import Flags, minimise, pseudo_huber, pseudo_huber_weight
from fantwin.twin.fitting.reading_errors import NORMAL_90_PERCENT
from fantwin.twin.models.narx import INPUTS, ORDER, UNITS, Narx, regressor_rows
from fantwin.twin.models.network import Scaling
from fantwin.twin.models.physics import PARAMETER_NAMES
from fantwin.twin.models.recursion import dtbtrs
from fantwin.twin.runs import Array, Run, starting_speed_rad_s

TOLERANCE = 1e-3
# Older samples say less about the next one; a factor of 0.7 per lag leaves about 0.03 for the oldest of ten.
LAG_DECAY = 0.7
LAG_SCALE = np.concatenate(
    [np.repeat(LAG_DECAY ** np.concatenate((np.arange(ORDER), np.arange(ORDER + 1))), UNITS), np.ones(2 * UNITS + 1)]
)
"""(1151,) relative size that is expected of each weight: it decays with the lag of its input"""

IterationDone = Callable[[float], None]
"""Called after every iteration with the free-run rmse in rad/s over the samples that count."""


@dataclass(frozen=True, eq=False)
class Candidate:
    """Weights theta (1151,), the speeds in rad/s of their free run of each stretch, and its cost."""

    theta: Array
    speeds: Sequence[Array]
    cost: float


class OutputErrorFit:
    """Fits theta to stretches: runs of one fan each, every one started from its first measured speeds.

    prior_mean: (1151,) the mean of the prior of each weight, whose relative strength follows from LAG_SCALE.
    """

    groups = 1

    def __init__(self, stretches: Sequence[Run], scaling: Scaling, prior_mean: Array) -> None:
        self.stretches, self.scaling, self.prior_mean = stretches, scaling, prior_mean
        self.measured = [np.isfinite(stretch.speed_rad_s[:, 0]) for stretch in stretches]
        self.precision, self.scale_rad_s = LAG_SCALE**-2, 1.0

    def minimise(
        self, theta: Array, prior_precision: float, max_iterations: int, iteration_done: IterationDone
    ) -> Array:
        """The weights after max_iterations at most, or when one lowers the cost by less than a thousandth.

        prior_precision: inverse variance of a weight of LAG_SCALE one, residuals having variance one.
        """

        def accepted(_iteration: int, point: Candidate) -> bool:
            iteration_done(float(np.sqrt(np.mean(self._residual(point.speeds) ** 2))))
            return False

        self.precision = prior_precision * LAG_SCALE**-2
        self.scale_rad_s = self._robust_scale(self._free_run(theta))
        point, _, _ = minimise(self, self._candidate(theta), max_iterations, TOLERANCE, accepted)
        return point.theta

    def total(self, point: Candidate) -> Array:
        """See damped_least_squares."""
        return np.array([point.cost])

    def normal_equations(self, point: Candidate) -> tuple[Array, Array]:
        """J^T W J (1151, 1151) and J^T W r (1151,) of the residuals in units of scale_rad_s, without the prior."""
        size = len(point.theta)
        squares, downhill = np.zeros((size, size)), np.zeros(size)
        for stretch, speed, measured in zip(self.stretches, point.speeds, self.measured, strict=True):
            by_theta = free_run_sensitivities(Narx(point.theta, self.scaling), speed, stretch.command[:, 0])
            residual = (stretch.speed_rad_s[measured, 0] - speed[measured]) / self.scale_rad_s
            root_weight = np.sqrt(pseudo_huber_weight(residual, 1.0))
            by_theta = by_theta[:, measured] * (root_weight / self.scale_rad_s)
            squares += by_theta @ by_theta.T
            downhill += by_theta @ (root_weight * residual)
        return squares, downhill

    def trial(self, point: Candidate, squares: Array, gradient: Array, damping: Array) -> Candidate:
        """See damped_least_squares. Without a step where sensitivities are not finite, or the matrix not definite."""
        damped = squares + np.diag(damping[0] * np.diag(squares) + self.precision)
        try:
            factor = cho_factor(damped, lower=True)
        except (np.linalg.LinAlgError, ValueError):
            return point
        downhill = gradient - self.precision * (point.theta - self.prior_mean)
        return self._candidate(point.theta + cho_solve(factor, downhill, check_finite=False))

    def merge(self, _old: Candidate, new: Candidate, _take_new: Flags) -> Candidate:
        """See damped_least_squares."""
        return new

    def _candidate(self, theta: Array) -> Candidate:
        speeds = self._free_run(theta)
        loss = float(np.sum(pseudo_huber(self._residual(speeds), self.scale_rad_s)))
        return Candidate(theta, speeds, loss + 0.5 * float(self.precision @ (theta - self.prior_mean) ** 2))

    def _free_run(self, theta: Array) -> list[Array]:
        """(n,) speeds in rad/s of each stretch."""
        model, unused = Narx(theta, self.scaling), np.ones((1, len(PARAMETER_NAMES)))
        speeds = []
        for stretch in self.stretches:
            state = model.state_layout.initial_state(starting_speed_rad_s(stretch.speed_rad_s), stretch.command[0])
            speeds.append(model.advance(state, stretch.command, stretch.step_s, unused)[0][:, 0])
        return speeds

    def _residual(self, speeds: Sequence[Array]) -> Array:
        """(m,) measured minus free run, in rad/s, of all measured samples."""
        return np.concatenate(
            [
                (stretch.speed_rad_s[:, 0] - speed)[measured]
                for stretch, speed, measured in zip(self.stretches, speeds, self.measured, strict=True)
            ]
        )

    def _robust_scale(self, speeds: Sequence[Array]) -> float:
        """Standard deviation of a normal residual with the same 90th percentile: a tenth may be outliers."""
        robust_std = float(np.quantile(np.abs(self._residual(speeds)), 0.9)) / NORMAL_90_PERCENT
        return max(robust_std, 1e-6 * self.scaling.speed_scale_rad_s)


def free_run_sensitivities(model: Narx, speed_rad_s: Array, command: Array) -> Array:
    """(1151, n) derivatives of a free run's speeds by theta. speed_rad_s: (n,) the free run. command: (n,)."""
    scaling, samples = model.scaling, len(command)
    regressors = regressor_rows(
        (speed_rad_s - scaling.speed_offset_rad_s) / scaling.speed_scale_rad_s,
        (command - scaling.command_offset) / scaling.command_scale,
    )[:-1].T
    input_weights, input_bias, output_weights, _ = model.weights()
    hidden = np.tanh(input_weights.T @ regressors + input_bias[:, np.newaxis])
    by_bias = output_weights[:, np.newaxis] * (1.0 - hidden * hidden)
    # Row by row the layout of theta, column by column the samples; nothing moves the first one.
    forcing = np.zeros((len(model.theta), samples))
    by_input = forcing[: INPUTS * UNITS].reshape(INPUTS, UNITS, samples)
    np.multiply(regressors[:, np.newaxis], by_bias, out=by_input[:, :, 1:])
    forcing[INPUTS * UNITS : -UNITS - 1, 1:] = by_bias
    forcing[-UNITS - 1 : -1, 1:] = hidden
    forcing[-1, 1:] = 1.0
    by_past = input_weights[:ORDER] @ by_bias
    bands = np.zeros((ORDER + 1, samples), order="F")
    bands[0] = 1.0
    for lag in range(ORDER):
        # LAPACK keeps a band by its columns: what sample k does to sample k + lag + 1.
        bands[lag + 1, : samples - 1 - lag] = -by_past[lag, lag:]
    solved, _ = dtbtrs(bands, forcing.T, uplo="L", diag="U", overwrite_b=1)
    return scaling.speed_scale_rad_s * solved.T


LEVELS = 16
# A fan without drive coasts far longer than its time constant at speed.
PROBE_TIME_CONSTANTS, SHORTEST_PROBE_SAMPLES = 30.0, 1000
# Beyond the range of training's speeds by a tenth of it on each side: a fan at rest may lie outside.
REACH = 1.2
# In shares of the range of speeds in training.
FORGOTTEN, MARGIN = 0.1, 0.5


def forgets_its_start(model: Narx, time_constant_samples: float) -> bool:
    """Whether both runs of each level end at the same speed, at most half the training range of speeds outside it.

    A stable free run forgets where it started, and stays near the recorded speeds. A recursion that fits its data can
    have a second, false steady state where there were no data, and a start or a jump of the command that was not in the
    training data can take it there permanently. Probing detects this without measured speeds: the network runs under
    long held commands over the range of training, from below the lowest and from above the highest speed of training.

    time_constant_samples: of the fan at speed, in samples.
    """
    scaling = model.scaling
    samples = max(round(PROBE_TIME_CONSTANTS * time_constant_samples), SHORTEST_PROBE_SAMPLES)
    level = scaling.command_offset + scaling.command_scale * np.tile(np.linspace(-1.0, 1.0, LEVELS), 2)
    start = scaling.speed_offset_rad_s + scaling.speed_scale_rad_s * np.repeat((-REACH, REACH), LEVELS)
    state = model.state_layout.initial_state(start, level)
    unused = np.ones((2 * LEVELS, len(PARAMETER_NAMES)))
    speed_rad_s, _ = model.advance(state, np.tile(level, (samples, 1)), np.ones(samples), unused)
    relative = (speed_rad_s - scaling.speed_offset_rad_s) / (2.0 * scaling.speed_scale_rad_s)
    from_low, from_high = relative[-1, :LEVELS], relative[-1, LEVELS:]
    return bool(np.all(np.abs(from_low - from_high) < FORGOTTEN) and np.all(np.abs(relative) < 0.5 + MARGIN))
