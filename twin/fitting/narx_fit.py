"""The free run of a NARX network fitted by regularised Levenberg-Marquardt with exact sensitivities (output error).

The free run is w[k+1] = f(w[k] .. w[k-9], commands, theta), so its derivative by a weight obeys the linear recursion
S[k+1] = sum_i (df/dw[k-i]) S[k-i] + df/dtheta. All samples and all weights together are one lower triangular system of
equations with ten bands, which LAPACK solves by substitution (dtbtrs).

Residuals beyond three robust standard deviations count linearly (pseudo-Huber loss, by iteratively reweighted least
squares); missing speeds do not count.
"""

from collections.abc import Callable, Sequence

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from fantwin.twin.fitting.free_run_problem import HUBER_DELTA
from fantwin.twin.fitting.reading_errors import NORMAL_90_PERCENT
from fantwin.twin.models.narx import INPUTS, ORDER, UNITS, Narx, regressor_rows
from fantwin.twin.models.network import Scaling
from fantwin.twin.models.physics import PARAMETER_NAMES
from fantwin.twin.models.recursion import dtbtrs
from fantwin.twin.runs import Array, Run, starting_speed_rad_s

TOLERANCE = 1e-3
FIRST_DAMPING, SMALLEST_DAMPING, LARGEST_DAMPING = 1e-3, 1e-9, 1e9

IterationDone = Callable[[float], None]
"""Called after every iteration with the free-run rmse in rad/s over the samples that count."""


class OutputErrorFit:
    """Fits theta to stretches: runs of one fan each, every one started from its first measured speeds.

    prior_mean, prior_weight: (1151,) the mean of the prior of each weight, and its relative strength.
    """

    def __init__(self, stretches: Sequence[Run], scaling: Scaling, prior_mean: Array, prior_weight: Array) -> None:
        self.stretches = stretches
        self.scaling = scaling
        self.prior_mean = prior_mean
        self.prior_weight = prior_weight
        self.measured = [np.isfinite(stretch.speed_rad_s[:, 0]) for stretch in stretches]

    def minimise(
        self, theta: Array, prior_precision: float, max_iterations: int, iteration_done: IterationDone
    ) -> Array:
        """The weights after max_iterations at most, or when one lowers the cost by less than a thousandth.

        prior_precision: inverse variance of a weight of prior_weight one, residuals having variance one.
        """
        precision = prior_precision * self.prior_weight
        speeds = self._free_run(theta)
        scale_rad_s = self._robust_scale(speeds)
        cost, damping = self._cost(theta, speeds, scale_rad_s, precision), FIRST_DAMPING
        for _ in range(max_iterations):
            squares, downhill = self._normal_equations(theta, speeds, scale_rad_s)
            downhill -= precision * (theta - self.prior_mean)
            diagonal, previous = np.diag(squares).copy(), cost
            while damping < LARGEST_DAMPING:
                try:
                    factor = cho_factor(squares + np.diag(damping * diagonal + precision), lower=True)
                except (np.linalg.LinAlgError, ValueError):
                    # Sensitivities are not finite, or the matrix is not definite: only a more damped step is possible.
                    damping *= 4.0
                    continue
                trial = theta + cho_solve(factor, downhill, check_finite=False)
                trial_speeds = self._free_run(trial)
                trial_cost = self._cost(trial, trial_speeds, scale_rad_s, precision)
                if trial_cost < cost:
                    theta, speeds, cost = trial, trial_speeds, trial_cost
                    damping = max(damping / 5.0, SMALLEST_DAMPING)
                    break
                damping *= 4.0
            iteration_done(float(np.sqrt(np.mean(self._residual(speeds) ** 2))))
            if previous - cost < TOLERANCE * previous:
                break
        return theta

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

    def _cost(self, theta: Array, speeds: Sequence[Array], scale_rad_s: float, precision: Array) -> float:
        relative = self._residual(speeds) / (HUBER_DELTA * scale_rad_s)
        loss = HUBER_DELTA**2 * float(np.sum(np.sqrt(1.0 + relative**2) - 1.0))
        return loss + 0.5 * float(precision @ (theta - self.prior_mean) ** 2)

    def _normal_equations(self, theta: Array, speeds: Sequence[Array], scale_rad_s: float) -> tuple[Array, Array]:
        """J^T W J (1151, 1151) and J^T W r (1151,) of the residuals in units of scale_rad_s."""
        squares, downhill = np.zeros((len(theta), len(theta))), np.zeros(len(theta))
        for stretch, speed, measured in zip(self.stretches, speeds, self.measured, strict=True):
            by_theta = free_run_sensitivities(Narx(theta, self.scaling), speed, stretch.command[:, 0])
            residual = (stretch.speed_rad_s[measured, 0] - speed[measured]) / scale_rad_s
            root_weight = (1.0 + (residual / HUBER_DELTA) ** 2) ** -0.25
            by_theta = by_theta[:, measured] * (root_weight / scale_rad_s)
            squares += by_theta @ by_theta.T
            downhill += by_theta @ (root_weight * residual)
        return squares, downhill


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
