"""The physical parameters of each fan, with their confidence intervals.

First the filtering operator (twin.filtering): least squares for a = alpha / J, a_N = C_D / J and b = 1 / J, equations
(11) to (20) of Peng and Chen. Its one free choice, lambda, is made by the data: of a ladder of values, the largest
whose parameters run freely nearly as well as the best's. A small lambda lives on slow drift, a large one on the
response to the command, which is what has to be learned.

Least squares on noisy regressors is biased, so that result only starts the refinement, a fit of the free run itself
(twin.free_run_fit). The inertia stays anchored to the start: under closed-loop control the speed hardly moves, and a
model so slow that it keeps its initial speed would otherwise be the best of all.

Standard errors come from the sandwich H^-1 (sum over blocks of g g^T) H^-1, with g the summed score of a block of
samples: unlike the plain inverse Hessian they stay honest when the residual is correlated in time, which it is
whenever the physics are not the whole truth.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import t as student_t

from twin import physics
from twin.errors import TwinError
from twin.filtering import filtered_regression
from twin.free_run_fit import HUBER_DELTA, FreeRunFit, fit_free_run, robust_scale
from twin.integration import free_run, free_run_sensitivities
from twin.physical import (
    PhysicalRightHandSide,
    fitted_physics,
    fitted_unknowns,
    parameters_by_unknowns,
    physical_parameters,
)
from twin.runs import Array, Run, common_fans
from twin.trajectories import Trajectories, cut_into_trajectories, stretch_samples

LAMBDA_LADDER = 9
STRETCH_TIME_CONSTANTS = 10.0
MAX_ITERATIONS = 30
SCORE_BLOCKS = 40
UNCERTAIN = 0.5
# The top speed is one that a fan reaches, not one that a sensor once told.
TOP_SPEED_QUANTILE = 0.99
# Data that excite a fan hold ten or more units of information about ln J per sample, a hundred times this anchor.
ANCHOR_PER_SAMPLE = 0.1
NEARLY_BEST = 1.25


@dataclass(frozen=True, eq=False)
class Identification:
    """Physical parameters per fan. Arrays of three hold J, alpha and C_D.

    parameters, standard_errors: (fans, 3). interval_95: (fans, 3, 2). lambda_per_s, rmse_rad_s, time_constant_s:
    (fans,); the time constant is taken at the median speed. iterations: those of the refinement. warnings: one line
    each, empty when all is well.
    """

    parameters: Array
    standard_errors: Array
    interval_95: Array
    lambda_per_s: Array
    rmse_rad_s: Array
    time_constant_s: Array
    iterations: int
    warnings: tuple[str, ...]


def identify(runs: Sequence[Run]) -> Identification:
    """Identify every fan of the runs. Raises TwinError when the data cannot tell the parameters."""
    fans = common_fans(runs)
    pieces = [piece for run in runs for piece in run.split_at_gaps()]
    for fan in range(fans):
        require_excitation(pieces, fan)
    top_speed = np.array([np.nanquantile(np.abs(_pooled(pieces, fan)[1]), TOP_SPEED_QUANTILE) for fan in range(fans)])
    start, lambda_per_s = _filtered_start(pieces, top_speed)
    speed = np.array([np.nanmedian(_pooled(pieces, fan)[1]) for fan in range(fans)])
    longest_s = float(np.max(_positive(physics.time_constant_s(speed, start), pieces)))
    step_s = min(piece.median_step_s for piece in pieces)
    trajectories = cut_into_trajectories(pieces, stretch_samples(longest_s, step_s, STRETCH_TIME_CONSTANTS))
    theta = fitted_unknowns(start, top_speed)
    fit = fit_free_run(
        lambda theta, fan: fitted_physics(theta[fan], top_speed[fan]),
        theta,
        trajectories,
        max_iterations=MAX_ITERATIONS,
        prior_precision=np.array([ANCHOR_PER_SAMPLE, 0.0, 0.0]) * np.count_nonzero(trajectories.measured) / fans,
        prior_mean=theta,
    )
    parameters = physical_parameters(fit.theta, top_speed)
    standard_errors, rmse = _standard_errors(fit, top_speed, trajectories)
    reach = student_t.ppf(0.975, SCORE_BLOCKS - 1) * standard_errors
    interval = np.stack((parameters - reach, parameters + reach), axis=-1)
    return Identification(
        parameters=parameters,
        standard_errors=standard_errors,
        interval_95=interval,
        lambda_per_s=lambda_per_s,
        rmse_rad_s=rmse,
        time_constant_s=_positive(physics.time_constant_s(speed, parameters), pieces),
        iterations=fit.iterations,
        warnings=_warnings(parameters, standard_errors),
    )


def filtering_operator(runs: Sequence[Run], fan: int, lambda_per_s: float) -> Array:
    """(3,) J, alpha, C_D of one fan by the filtering operator alone; NaN when the command does not drive the speed."""
    parts = [
        filtered_regression(run.t_s, run.speed_rad_s[:, fan], run.command[:, fan], _physical_basis, lambda_per_s)
        for run in runs
        if np.isfinite(run.speed_rad_s[:, fan]).sum() >= 2
    ]
    target = np.concatenate([part[0] for part in parts])
    regressors = np.concatenate([part[1] for part in parts])
    size = np.linalg.norm(regressors, axis=0) + np.finfo(float).tiny
    viscous_rate, drag_rate, gain = np.linalg.lstsq(regressors / size, target, rcond=None)[0] / size
    if not gain > 0.0:
        return np.full(3, np.nan)
    return np.array([1.0, viscous_rate, drag_rate]) / gain


def require_excitation(runs: Sequence[Run], fan: int) -> None:
    """Raise TwinError when a fan's command or speed never changes, or its speed was never measured."""
    command, speed_rad_s = _pooled(runs, fan)
    if np.isfinite(speed_rad_s).sum() < 10:
        raise TwinError(f"fan {fan}: fewer than ten measured speeds; check the speed column")
    if np.ptp(command) <= 1e-9 * np.abs(command).max():
        raise TwinError(f"fan {fan}: the command never changes; record steps between three levels or more")
    if np.nanmax(speed_rad_s) == np.nanmin(speed_rad_s):
        raise TwinError(f"fan {fan}: the speed never changes while the command does; check the sensor or the column")


def _filtered_start(pieces: Sequence[Run], top_speed_rad_s: Array) -> tuple[Array, Array]:
    """(fans, 3) parameters and (fans,) lambda: the largest rung that is nearly the best."""
    fans = len(top_speed_rad_s)
    longest_s = max(piece.duration_s for piece in pieces)
    step_s = min(piece.median_step_s for piece in pieces)
    ladder = np.geomspace(4.0 / longest_s, 0.5 / step_s, LAMBDA_LADDER)
    candidates = np.array([[filtering_operator(pieces, fan, rung) for fan in range(fans)] for rung in ladder])
    trajectories = cut_into_trajectories(pieces, stretch_samples(longest_s, step_s, 1.0))
    candidates = np.array([_stable(candidate, top_speed_rad_s) for candidate in candidates])
    errors = np.array([_free_run_errors(candidate, trajectories) for candidate in candidates])
    smallest = errors.min(axis=0)
    for fan in np.flatnonzero(~np.isfinite(smallest)):
        raise TwinError(f"fan {fan}: the speed does not follow the command; check which columns are command and speed")
    best = LAMBDA_LADDER - 1 - np.argmax((errors <= NEARLY_BEST * smallest)[::-1], axis=0)
    return candidates[best, np.arange(fans)], ladder[best]


def _stable(parameters: Array, top_speed_rad_s: Array) -> Array:
    """The parameters (fans, 3) with their damping made positive up to the top speed."""
    return physical_parameters(fitted_unknowns(parameters, top_speed_rad_s), top_speed_rad_s)


def _free_run_errors(parameters: Array, trajectories: Trajectories) -> Array:
    """(fans,) mean absolute free-run error in rad/s, the published loss; infinite when it does not exist."""
    rhs = PhysicalRightHandSide(parameters[trajectories.fan], np.zeros((len(trajectories.fan), 3, 3)))
    initial = trajectories.starting_speed_rad_s()
    speed, _ = free_run(rhs.acceleration, initial, trajectories.command, trajectories.step_s)
    measured = trajectories.measured
    error = np.where(measured, np.abs(trajectories.speed_rad_s - speed), 0.0).sum(axis=0)
    fans = len(parameters)
    mean = np.bincount(trajectories.fan, error, fans) / np.bincount(trajectories.fan, measured.sum(axis=0), fans)
    return np.where(np.isfinite(mean), mean, np.inf)


def _standard_errors(fit: FreeRunFit, top_speed_rad_s: Array, trajectories: Trajectories) -> tuple[Array, Array]:
    """(fans, 3) standard errors of J, alpha, C_D, and (fans,) free-run rmse in rad/s at the fit."""
    rhs = fitted_physics(fit.theta[trajectories.fan], top_speed_rad_s[trajectories.fan])
    data = trajectories
    speed, _ = free_run(rhs.acceleration, fit.initial_speed_rad_s, data.command, data.step_s)
    residual = np.where(data.measured, data.speed_rad_s - speed, 0.0)
    sensitivity = free_run_sensitivities(rhs, speed, data.command, data.step_s)
    scaled = residual / robust_scale(residual, data)[data.fan]
    weight = np.where(data.measured, 1.0 / np.hypot(1.0, scaled / HUBER_DELTA), 0.0)
    by_initial = sensitivity[:, :, -1:]
    weighted_initial = weight[:, :, np.newaxis] * by_initial
    overlap = np.sum(weighted_initial * sensitivity[:, :, :-1], axis=0) / np.sum(weighted_initial * by_initial, axis=0)
    own = sensitivity[:, :, :-1] - by_initial * overlap
    chain = parameters_by_unknowns(fit.theta, top_speed_rad_s)
    errors, rmse = np.empty_like(fit.theta), np.empty(len(fit.theta))
    for fan in range(len(fit.theta)):
        columns = data.fan == fan
        # Stretches one after the other, so that a block is a piece of time.
        slopes = own[:, columns].transpose(1, 0, 2).reshape(-1, 3)
        weights, residuals = weight[:, columns].T.ravel(), residual[:, columns].T.ravel()
        hessian = slopes.T @ (slopes * weights[:, np.newaxis])
        scores = np.array_split(slopes * (weights * residuals)[:, np.newaxis], SCORE_BLOCKS)
        blocks = np.array([block.sum(axis=0) for block in scores])
        bread = np.linalg.pinv(hessian)
        covariance = chain[fan] @ bread @ (blocks.T @ blocks) @ bread @ chain[fan].T
        errors[fan] = np.sqrt(np.diag(covariance))
        rmse[fan] = np.sqrt(np.sum(residuals**2) / np.count_nonzero(data.measured[:, columns]))
    return errors, rmse


def _warnings(parameters: Array, standard_errors: Array) -> tuple[str, ...]:
    lines = []
    for fan, (values, errors) in enumerate(zip(parameters, standard_errors, strict=True)):
        for name, value, error in zip(physics.PARAMETER_NAMES, values, errors, strict=True):
            if value < 0.0:
                lines.append(
                    f"fan {fan}: {name} is negative ({value:.3g}): the physical model does not describe this data "
                    "(friction, dead zone or offset); do not trust it outside the recorded speeds"
                )
            elif error > UNCERTAIN * value:
                lines.append(
                    f"fan {fan}: {name} is poorly determined ({value:.3g}, standard error {error:.2g}); "
                    "record more and wider command levels"
                )
    return tuple(lines)


def _physical_basis(speed_rad_s: Array, command: Array) -> Array:
    return np.column_stack((-speed_rad_s, -speed_rad_s * np.abs(speed_rad_s), command))


def _pooled(runs: Sequence[Run], fan: int) -> tuple[Array, Array]:
    return (
        np.concatenate([run.command[:, fan] for run in runs]),
        np.concatenate([run.speed_rad_s[:, fan] for run in runs]),
    )


def _positive(time_constant_s: Array, pieces: Sequence[Run]) -> Array:
    """Time constants, replaced by the longest run where the model has none, and never longer than that."""
    longest_s = max(piece.duration_s for piece in pieces)
    return np.where(time_constant_s > 0.0, np.minimum(time_constant_s, longest_s), longest_s)
