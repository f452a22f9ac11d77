"""The physical parameters of each fan, with their confidence intervals.

First the filtering operator (twin.fitting.filtering): least squares for a = alpha / J, a_N = C_D / J and b = 1 / J,
equations (11) to (20) of Peng and Chen, on the readings and on the commands as the tacho would show them
(twin.tacho_readings). Its one free choice, lambda, is made by the data: of a ladder of values, the
largest whose parameters give nearly the smallest free-run error. A small lambda is sensitive to slow drift; a large one
follows the response to the command, which is what has to be learned.

Least squares on noisy regressors is biased, so that result only starts the refinement, a fit of the free run itself
(twin.fitting.free_run_fit). The inertia stays anchored to the start: where the speed hardly moves, a model so slow that
it keeps its initial speed would otherwise fit best.

The lag of the command (twin.models.lag) is estimated with the rest and kept only if it is larger than its uncertainty;
otherwise it is zero, and the model is the published one of three parameters.

Covariances come from the jackknife over blocks of time, linearised: leaving out block b moves the estimate by
-(H - H_b)^-1 g_b, with g_b the summed score and H_b the curvature of that block. Unlike the plain inverse Hessian it
remains valid when the residual is correlated in time, which is the case whenever the physics are incomplete, and unlike
the sandwich of raw scores it remains valid when a few transients contain most of the information. Efron and Stein,
Annals of Statistics 9 (1981).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.special import stdtrit

from fantwin.twin.errors import TwinError
from fantwin.twin.fitting.damped_least_squares import Flags
from fantwin.twin.fitting.filtering import filtered_regression
from fantwin.twin.fitting.free_run_fit import FreeRunFit, fit_physics
from fantwin.twin.fitting.free_run_problem import ALL_FREE, FreeRunProblem, Prior
from fantwin.twin.fitting.identifiability import (
    TOP_SPEED_QUANTILE,
    feedback_share,
    identifiability_warnings,
    misfit_warnings,
    short_warnings,
    why_a_loop_tells_nothing,
)
from fantwin.twin.fitting.reading_errors import robust_scale
from fantwin.twin.fitting.trajectories import Trajectories, cut_into_trajectories, stretch_samples
from fantwin.twin.models import physics
from fantwin.twin.models.integration import free_run
from fantwin.twin.models.physical import PhysicalModel, fitted_unknowns, physical_parameters
from fantwin.twin.models.physics import LAG, PARAMETER_NAMES
from fantwin.twin.models.right_hand_side import FanEquation
from fantwin.twin.progress import Progress, unreported
from fantwin.twin.runs import Array, Run, common_fans
from fantwin.twin.tacho_readings import with_measured_command

LAMBDA_LADDER = 9
COLUMNS_AT_ONCE = 320  # fans times rungs: fewer cost as much as these, more need more memory
STRETCH_TIME_CONSTANTS = 10.0
BLOCKS = 40
# A lag counts from this many standard errors on: one fan in a thousand without a lag then gets one.
LAG_IN_STANDARD_ERRORS = 3.3
# Data that excite a fan hold ten or more units of information about ln J per sample, a hundred times this anchor.
ANCHOR_PER_SAMPLE = 0.1
NEARLY_BEST = 1.25
MOST_AHEAD, LEAST_ALIKE, TIMES_AS_ALIKE = 5, 0.3, 1.2
"""samples by which a speed may be found to be ahead of its command; least correlation of their changes with which it
is, and least multiple of that without a shift"""


@dataclass(frozen=True, eq=False)
class Identification:
    """Physical parameters per fan, in the order of physics.PARAMETER_NAMES.

    parameters, standard_errors: (fans, 4). covariance: (fans, 4, 4), degrees_of_freedom: (fans, 4) that it has.
    interval_95: (fans, 4, 2). A lag that was not found is zero, and so is its uncertainty. lambda_per_s, rmse_rad_s,
    time_constant_s, top_speed_rad_s: (fans,); the time constant is taken at the median speed. iterations: those of the
    refinement. warnings: one line each, empty when all is well. misfits: one line for the fans that physics alone do
    not describe, which is what a hybrid is for. closed_loop: (fans,) true where the command answers the speed.
    """

    parameters: Array
    covariance: Array
    degrees_of_freedom: Array
    lambda_per_s: Array
    rmse_rad_s: Array
    time_constant_s: Array
    top_speed_rad_s: Array
    iterations: int
    warnings: tuple[str, ...]
    misfits: tuple[str, ...]
    closed_loop: Flags

    @property
    def standard_errors(self) -> Array:
        """(fans, 4)"""
        return np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2))

    @property
    def interval_95(self) -> Array:
        """(fans, 4, 2), of the t distribution with the degrees of freedom of each."""
        reach = stdtrit(self.degrees_of_freedom, 0.975) * self.standard_errors
        return np.stack((self.parameters - reach, self.parameters + reach), axis=-1)


def identify(runs: Sequence[Run], *, progress: Progress = unreported) -> Identification:
    """Identify every fan of the runs. Raises TwinError when the data do not determine the parameters."""
    fans = common_fans(runs)
    pieces = [piece for run in runs for piece in run.split_at_gaps()]
    closed_loop = np.array([in_a_loop(pieces, fan) for fan in range(fans)])
    top_speed = np.array([_top_speed_rad_s(_pooled(pieces, fan)[1]) for fan in range(fans)])
    start, lambda_per_s = _filtered_start(pieces, top_speed, progress)
    speed = np.array([np.nanmedian(_pooled(pieces, fan)[1]) for fan in range(fans)])
    longest_s = float(np.max(_positive(physics.time_constant_s(speed, start), pieces)))
    step_s = min(piece.median_period_s for piece in pieces)
    trajectories = cut_into_trajectories(pieces, stretch_samples(longest_s, step_s, STRETCH_TIME_CONSTANTS))
    free = np.tile(ALL_FREE, (fans, 1))
    fit, covariance, freedom = _refine(start, free, top_speed, trajectories, "identification", progress)
    lag_s = physical_parameters(fit.point.unknowns.physics, top_speed)[:, LAG]
    unseen = free[:, LAG] & (lag_s <= LAG_IN_STANDARD_ERRORS * np.sqrt(covariance[:, LAG, LAG]))
    iterations = fit.iterations
    if np.any(unseen):
        free[:, LAG] &= ~unseen
        without = physical_parameters(fit.point.unknowns.physics, top_speed)
        without[unseen, LAG] = 0.0
        part = "identification without lag"
        fit, covariance, freedom = _refine(without, free, top_speed, trajectories, part, progress, start)
        iterations += fit.iterations
    parameters = physical_parameters(fit.point.unknowns.physics, top_speed)
    rmse_rad_s = trajectories.rms_of_fans(fit.error_rad_s)
    measurement = trajectories.measurement
    noise_rad_s = measurement.noise_rad_s(measurement.of_speed(fit.point.speed_rad_s))  # about a perfect model
    time_constant_s = _positive(physics.time_constant_s(speed, parameters), pieces)
    progress("identification: checks", 0, 0, np.nan)
    return Identification(
        parameters=parameters,
        covariance=covariance,
        degrees_of_freedom=freedom,
        lambda_per_s=lambda_per_s,
        rmse_rad_s=rmse_rad_s,
        time_constant_s=time_constant_s,
        top_speed_rad_s=top_speed,
        iterations=iterations,
        warnings=(
            *short_warnings(pieces, time_constant_s),
            *identifiability_warnings(runs, parameters, covariance),
        ),
        misfits=misfit_warnings(pieces, rmse_rad_s, trajectories.rms_of_fans(noise_rad_s)),
        closed_loop=closed_loop,
    )


def in_a_loop(pieces: Sequence[Run], fan: int) -> bool:
    """Whether the command of a fan answers its speed. Raises TwinError where nothing else has moved it."""
    require_excitation(pieces, fan)
    is_closed = feedback_share(pieces, fan) > 0.0
    if is_closed and (why := why_a_loop_tells_nothing(pieces, fan)):
        raise TwinError(f"fan {fan}: {why}")
    return is_closed


def filtering_operator(runs: Sequence[Run], fan: int, lambda_per_s: float) -> Array:
    """(4,) J, alpha, C_D of one fan by the filtering operator alone, lag 0; NaN when the command does not drive it."""
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
        return np.full(len(PARAMETER_NAMES), np.nan)
    return np.array([1.0 / gain, viscous_rate / gain, drag_rate / gain, 0.0])


def require_excitation(runs: Sequence[Run], fan: int) -> None:
    """Raise TwinError when a fan's command or speed never changes, or its speed was never measured."""
    command, speed_rad_s = _pooled(runs, fan)
    if np.isfinite(speed_rad_s).sum() < 10:
        raise TwinError(f"fan {fan}: fewer than ten measured speeds; check the speed column")
    if np.ptp(command) <= 1e-9 * np.abs(command).max():
        raise TwinError(f"fan {fan}: the command never changes; record steps between three levels or more")
    if np.nanmax(speed_rad_s) == np.nanmin(speed_rad_s):
        raise TwinError(f"fan {fan}: the speed never changes while the command does; check the sensor or the column")


def _filtered_start(pieces: Sequence[Run], top_speed_rad_s: Array, progress: Progress) -> tuple[Array, Array]:
    """(fans, 4) parameters and (fans,) lambda: the largest rung that is nearly the best."""
    fans = len(top_speed_rad_s)
    longest_s = max(piece.duration_s for piece in pieces)
    step_s = min(piece.median_period_s for piece in pieces)
    ladder = np.geomspace(4.0 / longest_s, 0.5 / step_s, LAMBDA_LADDER)
    alike = [with_measured_command(piece) for piece in pieces]
    trajectories = cut_into_trajectories(pieces, stretch_samples(longest_s, step_s, 1.0))
    candidates = np.zeros((len(ladder), fans, len(PARAMETER_NAMES)))
    for rung, lambda_per_s in enumerate(ladder):
        progress("identification: first estimate", rung, len(ladder), np.nan)
        filtered = np.array([filtering_operator(alike, fan, lambda_per_s) for fan in range(fans)])
        # Damping is made positive up to the top speed.
        candidates[rung] = physical_parameters(fitted_unknowns(filtered, top_speed_rad_s), top_speed_rad_s)
    together = max(1, COLUMNS_AT_ONCE // len(trajectories.fan))
    errors = np.concatenate(
        [
            _free_run_errors(candidates[first : first + together], trajectories)
            for first in range(0, len(ladder), together)
        ]
    )
    smallest = errors.min(axis=0)
    for fan in np.flatnonzero(~np.isfinite(smallest)):
        raise TwinError(f"fan {fan}: {_why_not(pieces, int(fan))}")
    best = LAMBDA_LADDER - 1 - np.argmax((errors <= NEARLY_BEST * smallest)[::-1], axis=0)
    return candidates[best, np.arange(fans)], ladder[best]


def _why_not(pieces: Sequence[Run], fan: int) -> str:
    """Why the speed of a fan seems not to follow its command: gaps may leave nothing of it, its supply may fail, or it
    may be earlier than the command, by some samples."""
    longest = max(len(piece.command) for piece in pieces)
    if longest <= 2 * MOST_AHEAD:
        return f"gaps cut the recording into runs of {longest} samples at most: record without gaps"
    command, speed = _pooled(pieces, fan)
    is_lost = (speed == 0.0) & (command > np.median(command[speed != 0.0]))
    if np.count_nonzero(is_lost) > 1:
        return (
            f"the speed is 0 in {np.count_nonzero(is_lost)} samples at commands from {command[is_lost].min():g}, and "
            "not at lower ones: did its supply fail? Leave these rows out"
        )
    steps = [np.diff((piece.command[:, fan], np.nan_to_num(piece.speed_rad_s[:, fan]))) for piece in pieces]
    size = np.sqrt(np.prod(sum(np.square(step).sum(axis=1) for step in steps)))
    if not size > 0.0:
        return "no command, or no speed, changes within a run: gaps cut the recording at each change"
    alike = [
        sum(float(command[ahead:] @ speed[: max(0, len(speed) - ahead)]) for command, speed in steps) / size
        for ahead in range(MOST_AHEAD + 1)
    ]
    ahead = int(np.argmax(alike))
    if alike[ahead] > max(LEAST_ALIKE, TIMES_AS_ALIKE * alike[0]):
        seconds = ahead * float(np.median([piece.median_period_s for piece in pieces]))
        return (
            f"the speed changes about {seconds:.3g} s before the command does; does each row carry the time at which "
            "its count of pulses begins? Give it the time at which the count ends"
        )
    return "the speed does not follow the command; check which columns are command and speed"


def _free_run_errors(candidates: Array, trajectories: Trajectories) -> Array:
    """(rungs, fans) mean absolute free-run error in rad/s of candidates (rungs, fans, 4), the published loss; infinite
    when it does not exist.
    """
    rungs, fans = candidates.shape[:2]
    equation = FanEquation(np.concatenate(candidates[:, trajectories.fan]), None)
    initial, command, step_s, guess = (
        np.concatenate([of_one] * rungs, axis=-1)
        for of_one in (
            trajectories.starting_speed_rad_s(),
            trajectories.command,
            trajectories.step_s,
            trajectories.interpolated_speed_rad_s(),
        )
    )
    speed, _ = free_run(equation, initial, command, step_s, guess)
    compared = trajectories.compared
    samples = np.bincount(trajectories.fan, compared.sum(axis=0), fans)
    errors = []
    for of_rung in np.split(speed, rungs, axis=1):
        shown = trajectories.measurement.of_speed(of_rung)
        error = np.where(compared, np.abs(trajectories.speed_rad_s - shown), 0.0).sum(axis=0)
        errors.append(np.bincount(trajectories.fan, error, fans) / samples)
    return np.where(np.isfinite(errors), errors, np.inf)


def _refine(
    start: Array,
    free: Flags,
    top_speed_rad_s: Array,
    trajectories: Trajectories,
    part: str,
    progress: Progress,
    anchor: Array | None = None,
) -> tuple[FreeRunFit, Array, Array]:
    """The fit of the free run from parameters (fans, 4), and what _covariance says of it. part: its name in reports."""
    pull = inertia_anchor(np.count_nonzero(trajectories.compared) / len(start))
    held_to = fitted_unknowns(start if anchor is None else anchor, top_speed_rad_s)
    problem = FreeRunProblem(PhysicalModel(), trajectories, top_speed_rad_s, free, Prior(0.0, pull, held_to))
    fit = fit_physics(problem, fitted_unknowns(start, top_speed_rad_s), part, progress)
    return fit, *_covariance(fit, replace(problem, free=free))


def inertia_anchor(samples: float) -> Array:
    """(4,) precision with which the own unknowns of a fan with so many samples are held to where they started."""
    pull = np.zeros(len(PARAMETER_NAMES))
    pull[0] = ANCHOR_PER_SAMPLE * samples
    return pull


def _covariance(fit: FreeRunFit, problem: FreeRunProblem) -> tuple[Array, Array]:
    """Covariance (fans, 4, 4) of J, alpha, C_D, lag_s by the block jackknife, zero where one is held, and its degrees
    of freedom (fans, 4).

    Few where few blocks hold most of the information:
    the variance of a sum of squares d_b^2 of normal moves is 2/3 of sum d_b^4, and a
    chi-square with that variance has 3 (sum d_b^2)^2 / sum d_b^4 of them (Satterthwaite, Biometrics Bulletin 2, 1946).
    """
    trajectories = problem.trajectories
    problem.scale_rad_s = robust_scale(fit.error_rad_s, trajectories)
    everything = slice(None)
    sensitivity = problem.sensitivities(fit.point, everything)
    weight = problem.sample_weights(fit.error_rad_s, everything)
    by_initial = sensitivity[:, :, -1:]
    weighted_initial = weight[:, :, np.newaxis] * by_initial
    overlap = np.sum(weighted_initial * sensitivity[:, :, :-1], axis=0) / np.sum(weighted_initial * by_initial, axis=0)
    slopes_of_all = sensitivity[:, :, :-1] - by_initial * overlap
    chain = problem.parameters_by_unknowns(fit.point.unknowns)
    covariance = np.zeros((len(chain), len(PARAMETER_NAMES), len(PARAMETER_NAMES)))
    freedom = np.full((len(chain), len(PARAMETER_NAMES)), BLOCKS - 1.0)
    for fan in range(len(chain)):
        columns, known = trajectories.fan == fan, np.flatnonzero(problem.free[fan])
        # Stretches one after the other, so that a block is a piece of time.
        slopes = slopes_of_all[:, columns].transpose(1, 0, 2).reshape(-1, len(PARAMETER_NAMES))[:, known]
        weights, residual = weight[:, columns].T.ravel(), fit.error_rad_s[:, columns].T.ravel()
        # Padding and missing samples hold no information: blocks are shares of the measured samples.
        counted = weights > 0.0
        slopes, weights, residual = slopes[counted], weights[counted], residual[counted]
        scores = slopes * (weights * residual)[:, np.newaxis]
        # The second derivative of the pseudo-Huber loss, where a step of the fit makes do with its secant.
        weighted = slopes * weights[:, np.newaxis] ** 3
        bounds = np.linspace(0, len(slopes), BLOCKS + 1).astype(int)
        blocks = [slice(first, last) for first, last in pairwise(bounds)]
        curvatures = np.array([slopes[block].T @ weighted[block] for block in blocks])
        rest = curvatures.sum(axis=0) - curvatures
        if not np.all(np.isfinite(rest)):
            raise TwinError(f"fan {fan}: the free run of its physical model overflows; record open-loop steps")
        moves = np.einsum("bpq,bq->bp", np.linalg.pinv(rest), [scores[block].sum(axis=0) for block in blocks])
        moves = (moves - moves.mean(axis=0)) @ chain[fan][:, known].T
        covariance[fan] = (BLOCKS - 1) / BLOCKS * moves.T @ moves
        fourth = np.sum(moves**4, axis=0)
        known = fourth > 0.0
        freedom[fan, known] = np.clip(3.0 * np.sum(moves**2, axis=0)[known] ** 2 / fourth[known], 2.0, BLOCKS - 1)
    return covariance, freedom


def _physical_basis(speed_rad_s: Array, command: Array) -> Array:
    return np.column_stack((-speed_rad_s, -speed_rad_s * np.abs(speed_rad_s), command))


def _top_speed_rad_s(speed_rad_s: Array) -> float:
    """A speed that the fan reaches; the largest one if it hardly ever turns."""
    magnitude = np.abs(speed_rad_s)
    return float(np.nanquantile(magnitude, TOP_SPEED_QUANTILE)) or float(np.nanmax(magnitude))


def _pooled(runs: Sequence[Run], fan: int) -> tuple[Array, Array]:
    return (
        np.concatenate([run.command[:, fan] for run in runs]),
        np.concatenate([run.speed_rad_s[:, fan] for run in runs]),
    )


def _positive(time_constant_s: Array, pieces: Sequence[Run]) -> Array:
    """Time constants, limited to the longest run, which also replaces undefined ones."""
    longest_s = max(piece.duration_s for piece in pieces)
    return np.where(time_constant_s > 0.0, np.minimum(time_constant_s, longest_s), longest_s)
