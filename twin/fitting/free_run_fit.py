"""Levenberg-Marquardt on the free-run error, with exact sensitivities.

Minimises the sum of a pseudo-Huber loss of (reading - that of the free run) / scale over every sample that is compared;
if asked, with what is known of the errors of readings (twin.fitting.reading_errors). What the tachos are expected
to show of a free run is linear in it (twin.measurement), and so in its sensitivities. The unknowns are

    the weights of a network, shared by all fans,
    each fan's own physics (twin.models.physical: ln J, two ln dampings, lag), and
    the initial speed of each trajectory.

The scale is a robust standard deviation of each fan's residual, so that outliers count linearly and fans with different
noise count equally. Initial speeds are coupled with other unknowns only in their own trajectory, and physics only in
their own fan: both are eliminated from the normal equations (Schur complements), so that a thousand trajectories and a
hundred fans cost no more than their own integration. More, Numerical Analysis, LNM 630 (1978), for the damping by the
diagonal.

Without shared weights every fan is damped, accepted and stopped by itself, as if it were fitted alone,
and what has converged is left out of further steps as soon as that pays.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from fantwin.twin.fitting.free_run_problem import OF_STEADY_SPEEDS, Flags, FreeRunProblem, Point, Prior, Unknowns
from fantwin.twin.fitting.reading_errors import counts, robust_scale
from fantwin.twin.fitting.trajectories import Trajectories
from fantwin.twin.models.model import OdeModel
from fantwin.twin.runs import Array

SCALE_ROUNDS, ERROR_ROUNDS = 2, 4  # with a constant scale, or with what was learned of the errors of readings
DAMPING_DOWN, DAMPING_UP = 3.0, 4.0
FIRST_DAMPING, SMALLEST_DAMPING, LARGEST_DAMPING = 1e-3, 1e-9, 1e9


@dataclass(frozen=True, eq=False)
class FreeRunFit:
    """The solution. rmse_rad_s over all samples. error_rad_s: (n, batch), zero where nothing is compared."""

    point: Point
    rmse_rad_s: float
    error_rad_s: Array
    iterations: int


IterationDone = Callable[[int, Unknowns, float], bool]
"""Called with iteration, unknowns and rmse in rad/s after each accepted step; true stops the fit."""


def fit_free_run(
    model: OdeModel,
    physics: Array,
    top_speed_rad_s: Array,
    trajectories: Trajectories,
    *,
    free: Flags,
    prior: Prior,
    max_iterations: int,
    tolerance: float = 1e-5,
    estimate_initial_speed: bool = True,
    with_errors: bool = False,
    iteration_done: IterationDone | None = None,
) -> FreeRunFit:
    """Fit the weights of the model, where it has any, starting from its own, and the free ones of the physics unknowns.

    physics: (fans, 4) to start from. top_speed_rad_s: (fans,). free: (4,) or (fans, 4).
    estimate_initial_speed: otherwise the first measured speeds are used, as in operation; an unstable equilibrium
    then cannot be hidden by an initial speed that happens to lie on it. with_errors: readings of tachos that count are
    taken with the errors that they have in the free run of each round (twin.fitting.reading_errors); inertia and lag
    are held, for what shows them then counts little. It stops when a step lowers the cost by less than tolerance,
    relative, or when none lowers it.
    """
    problem = FreeRunProblem(model, trajectories, top_speed_rad_s, free, prior, estimate_initial_speed)

    def accepted(iteration: int, point: Point) -> bool:
        return iteration_done is not None and iteration_done(iteration, point.unknowns, problem.rmse_rad_s(point))

    start = Unknowns(model.theta, physics, trajectories.starting_speed_rad_s())
    point = problem.evaluate(start, trajectories.interpolated_speed_rad_s())
    iteration = 0
    learns_errors = with_errors and counts(trajectories)
    if learns_errors:
        problem.free = problem.free & OF_STEADY_SPEEDS
    for _ in range(ERROR_ROUNDS if learns_errors else SCALE_ROUNDS):
        if learns_errors:
            problem.learn_errors(point)
            point = problem.evaluate(point.unknowns, point.speed_rad_s)
        problem.scale_rad_s = robust_scale(point.residual, trajectories)
        point = problem.evaluate(point.unknowns, point.speed_rad_s)
        point, iteration, stopped = _descend(problem, point, iteration, max_iterations, tolerance, accepted)
        if stopped:
            break
    return FreeRunFit(point, problem.rmse_rad_s(point), point.residual / problem.errors.weight, iteration)


def _descend(
    problem: FreeRunProblem,
    point: Point,
    iteration: int,
    max_iterations: int,
    tolerance: float,
    accepted: Callable[[int, Point], bool],
    damping: Array | None = None,
) -> tuple[Point, int, bool]:
    """Iterate to the next minimum with a constant scale. Also returns whether it was stopped. damping: (groups,)."""
    groups = problem.groups
    damping = np.full(groups, FIRST_DAMPING) if damping is None else damping
    cost = problem.total(point)
    active = np.isfinite(cost)
    normal: tuple[Array, Array] | None = None
    while iteration < max_iterations and np.any(active):
        if normal is None and problem.pays_for_some(active):
            part = problem.of_fans(active)

            def whole(found: Point, others: Point = point, fans: Flags = active) -> Point:
                return problem.with_point_of_some(others, found, fans)

            found, iteration, stopped = _descend(
                part,
                problem.point_of_some(point, active),
                iteration,
                max_iterations,
                tolerance,
                lambda count, found: accepted(count, whole(found)),
                damping[active],
            )
            return whole(found), iteration, stopped
        iteration += 1
        normal = problem.normal_equations(point) if normal is None else normal
        trial = problem.evaluate(problem.step(point, *normal, damping), point.speed_rad_s)
        trial_cost = problem.total(trial)
        better = active & (trial_cost < cost)
        gain = np.zeros(groups)
        gain[better] = (cost[better] - trial_cost[better]) / cost[better]
        damping = np.where(better, np.maximum(damping / DAMPING_DOWN, SMALLEST_DAMPING), damping * DAMPING_UP)
        active &= ~(better & (gain < tolerance)) & (damping < LARGEST_DAMPING)
        if not np.any(better):
            continue
        point, cost, normal = problem.merge(point, trial, better), np.where(better, trial_cost, cost), None
        if accepted(iteration, point):
            return point, iteration, True
    return point, iteration, iteration >= max_iterations
