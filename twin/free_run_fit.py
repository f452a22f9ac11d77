"""Levenberg-Marquardt on the free-run error, with exact sensitivities.

Minimises the sum of a pseudo-Huber loss of (measured - free run) / scale over every measured sample, by theta and by
the initial speed of each trajectory. The scale is a robust spread of the starting residual of each fan, so that
outliers count linearly and fans of different noise count alike. Initial speeds meet the parameters only in their own
trajectory: they are eliminated from the normal equations (Schur complement), so a thousand trajectories cost no more
than their own integration. More, Numerical Analysis, LNM 630 (1978), for the damping by the diagonal.

theta has one row per group: one row for all fans (a shared network) or one row per fan (physics). Rows are damped,
accepted and stopped independently, as if each were fitted alone.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from twin.integration import RightHandSide, free_run, free_run_sensitivities
from twin.runs import Array
from twin.trajectories import Trajectories

Family = Callable[[Array, NDArray[np.intp]], RightHandSide]
"""theta (groups, P) and fan (batch,) to the right-hand side of that batch."""
IterationDone = Callable[[int, Array, float], bool]
"""Called with iteration, theta and rmse in rad/s after each accepted step; true stops the fit."""

HUBER_DELTA = 3.0
NORMAL_90_PERCENT = 1.645
MAX_CHUNK_NUMBERS = 4_000_000
DAMPING_DOWN, DAMPING_UP = 2.0, 4.0
SMALLEST_DAMPING, LARGEST_DAMPING = 1e-9, 1e9


@dataclass(frozen=True, eq=False)
class FreeRunFit:
    """theta: (groups, P). initial_speed_rad_s: (batch,). rmse_rad_s over all samples."""

    theta: Array
    initial_speed_rad_s: Array
    rmse_rad_s: float
    iterations: int


@dataclass(frozen=True, eq=False)
class _Point:
    """One candidate: its residual (n, batch), zero where missing, and its cost (groups,)."""

    theta: Array
    initial_speed_rad_s: Array
    speed_rad_s: Array
    residual: Array
    cost: Array


def fit_free_run(
    family: Family,
    theta: Array,
    trajectories: Trajectories,
    *,
    max_iterations: int,
    prior_precision: Array | float = 0.0,
    prior_mean: Array | float = 0.0,
    tolerance: float = 1e-5,
    estimate_initial_speed: bool = True,
    iteration_done: IterationDone | None = None,
) -> FreeRunFit:
    """Fit theta (groups, P), starting there; prior_precision, a number or (P,), pulls it
    towards prior_mean. estimate_initial_speed: otherwise the first measured speeds stand, as they do in service; an
    unstable equilibrium cannot then hide behind an initial speed that happens to balance on it.

    A group stops when a step lowers its cost by less than tolerance, relative, or when no step lowers it.
    """
    problem = _Problem(family, trajectories, theta, prior_precision, prior_mean, estimate_initial_speed)
    point = problem.evaluate(theta, trajectories.starting_speed_rad_s())
    groups = len(theta)
    damping = np.full(groups, 1e-3)
    active = np.isfinite(point.cost)
    normal: tuple[Array, Array] | None = None
    iteration = 0
    while iteration < max_iterations and np.any(active):
        iteration += 1
        normal = problem.normal_equations(point) if normal is None else normal
        trial = problem.evaluate(*problem.step(point, *normal, damping))
        better = active & (trial.cost < point.cost)
        gain = np.where(better, (point.cost - trial.cost) / point.cost, 0.0)
        damping = np.where(better, np.maximum(damping / DAMPING_DOWN, SMALLEST_DAMPING), damping * DAMPING_UP)
        active &= ~(better & (gain < tolerance)) & (damping < LARGEST_DAMPING)
        if not np.any(better):
            continue
        point, normal = problem.merge(point, trial, better), None
        if iteration_done is not None and iteration_done(iteration, point.theta, problem.rmse(point)):
            break
    return FreeRunFit(point.theta, point.initial_speed_rad_s, problem.rmse(point), iteration)


class _Problem:
    """The sum of squares and its normal equations for one set of trajectories."""

    def __init__(
        self,
        family: Family,
        trajectories: Trajectories,
        theta: Array,
        prior_precision: Array | float,
        prior_mean: Array | float,
        estimate_initial_speed: bool,
    ) -> None:
        self.family = family
        self.trajectories = trajectories
        self.prior_precision = prior_precision
        self.prior_mean = prior_mean
        self.estimate_initial_speed = estimate_initial_speed
        self.groups = len(theta)
        self.group = trajectories.fan if self.groups > 1 else np.zeros_like(trajectories.fan)
        self.scale = np.ones(len(trajectories.fan))
        start = self.evaluate(theta, trajectories.starting_speed_rad_s())
        self.scale = robust_scale(start.residual, trajectories)[trajectories.fan]

    def evaluate(self, theta: Array, initial_speed_rad_s: Array) -> _Point:
        data = self.trajectories
        rhs = self.family(theta, data.fan)
        speed, _ = free_run(rhs.acceleration, initial_speed_rad_s, data.command, data.step_s)
        with np.errstate(over="ignore", invalid="ignore"):
            residual = np.where(data.measured, data.speed_rad_s - speed, 0.0)
            loss = HUBER_DELTA**2 * (np.hypot(1.0, residual / (HUBER_DELTA * self.scale)) - 1.0)
            cost = np.bincount(self.group, loss.sum(axis=0), self.groups)
            cost += 0.5 * np.sum(self.prior_precision * (theta - self.prior_mean) ** 2, axis=1)
        cost[~np.isfinite(cost)] = np.inf
        return _Point(theta, initial_speed_rad_s, speed, residual, cost)

    def normal_equations(self, point: _Point) -> tuple[Array, Array]:
        """Per trajectory the weighted S^T S (batch, P + 1, P + 1) and S^T residual (batch, P + 1)."""
        data = self.trajectories
        steps, batch = data.command.shape
        size = point.theta.shape[1] + 1
        squares, gradient = np.empty((batch, size, size)), np.empty((batch, size))
        width = max(1, MAX_CHUNK_NUMBERS // (steps * size))
        for first in range(0, batch, width):
            part = slice(first, first + width)
            rhs = self.family(point.theta, data.fan[part])
            sensitivity = free_run_sensitivities(
                rhs, point.speed_rad_s[:, part], data.command[:, part], data.step_s[:, part]
            ).transpose(1, 0, 2)
            scaled = point.residual[:, part] / self.scale[part]
            weight = np.where(data.measured[:, part], 1.0 / np.hypot(1.0, scaled / HUBER_DELTA), 0.0)
            weight /= self.scale[part] ** 2
            weighted = sensitivity * weight.T[:, :, np.newaxis]
            squares[part] = weighted.transpose(0, 2, 1) @ sensitivity
            gradient[part] = np.einsum("bnp,nb->bp", weighted, point.residual[:, part])
        return squares, gradient

    def step(self, point: _Point, squares: Array, gradient: Array, damping: Array) -> tuple[Array, Array]:
        """The damped Gauss-Newton step: new theta and new initial speeds."""
        size = point.theta.shape[1]
        # An initial speed that is not estimated is one of infinite curvature: it takes no share and does not move.
        known = 1.0 if self.estimate_initial_speed else np.inf
        by_initial = known * squares[:, -1, -1] * (1.0 + damping[self.group])
        coupling = squares[:, :-1, -1] / by_initial[:, np.newaxis]
        reduced = squares[:, :-1, :-1] - coupling[:, :, np.newaxis] * squares[:, np.newaxis, :-1, -1]
        reduced_gradient = gradient[:, :-1] - coupling * gradient[:, -1:]
        hessian, downhill, diagonal = (
            np.zeros((self.groups, size, size)),
            np.zeros_like(point.theta),
            np.zeros_like(point.theta),
        )
        np.add.at(hessian, self.group, reduced)
        np.add.at(downhill, self.group, reduced_gradient)
        np.add.at(diagonal, self.group, np.diagonal(squares[:, :-1, :-1], axis1=1, axis2=2))
        # A parameter without any effect still needs a pivot: the floor keeps the system solvable and the step zero.
        floor = 1e-12 * diagonal.max(axis=1, keepdims=True) + np.finfo(float).tiny
        ridge = damping[:, np.newaxis] * diagonal + self.prior_precision + floor
        hessian[:, np.arange(size), np.arange(size)] += ridge
        downhill -= self.prior_precision * (point.theta - self.prior_mean)
        move = np.linalg.solve(hessian, downhill[:, :, np.newaxis])[:, :, 0]
        initial_move = gradient[:, -1] / by_initial - np.sum(coupling * move[self.group], axis=1)
        return point.theta + move, point.initial_speed_rad_s + initial_move

    def merge(self, old: _Point, new: _Point, take_new: NDArray[np.bool_]) -> _Point:
        """The new point for the groups that take it, the old one for the others."""
        column = take_new[self.group]
        return _Point(
            theta=np.where(take_new[:, np.newaxis], new.theta, old.theta),
            initial_speed_rad_s=np.where(column, new.initial_speed_rad_s, old.initial_speed_rad_s),
            speed_rad_s=np.where(column, new.speed_rad_s, old.speed_rad_s),
            residual=np.where(column, new.residual, old.residual),
            cost=np.where(take_new, new.cost, old.cost),
        )

    def rmse(self, point: _Point) -> float:
        return float(np.sqrt(np.sum(point.residual**2) / np.count_nonzero(self.trajectories.measured)))


def robust_scale(residual: Array, trajectories: Trajectories) -> Array:
    """(fans,) standard deviation of a normal residual with the same 90th percentile of magnitude.

    One sample in ten may be an outlier. Never below a millionth of the fan's speed range, nor above that range, which
    it is where the free run diverged.
    """
    fans = int(trajectories.fan.max()) + 1
    scale = np.ones(fans)
    for fan in np.unique(trajectories.fan):
        columns = trajectories.fan == fan
        measured = trajectories.measured[:, columns]
        magnitude = np.abs(residual[:, columns][measured])
        span = float(np.ptp(trajectories.speed_rad_s[:, columns][measured]))
        # A magnitude beyond the range says nothing more, and may be infinite.
        spread = float(np.quantile(np.fmin(magnitude, span), 0.9)) / NORMAL_90_PERCENT
        scale[fan] = max(spread, 1e-6 * span, np.finfo(float).tiny)
    return scale
