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
hundred fans cost no more than their own integration. The loop is that of twin.fitting.damped_least_squares; without
shared weights every fan is a group of its own.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from fantwin.twin.fitting.damped_least_squares import minimise
from fantwin.twin.fitting.free_run_problem import OF_STEADY_SPEEDS, Flags, FreeRunProblem, Point, Prior, Unknowns
from fantwin.twin.fitting.reading_errors import counts
from fantwin.twin.fitting.trajectories import Trajectories
from fantwin.twin.models.fan_ode import FanOde
from fantwin.twin.progress import Progress
from fantwin.twin.runs import Array

SCALE_ROUNDS, ERROR_ROUNDS = 2, 4  # with a constant scale, or with what was learned of the errors of readings
MOST_ITERATIONS_OF_PHYSICS = 60


@dataclass(frozen=True, eq=False)
class FreeRunFit:
    """The solution. rmse_rad_s over all samples. error_rad_s: (n, batch), zero where nothing is compared."""

    point: Point
    rmse_rad_s: float
    error_rad_s: Array
    iterations: int

    def rmse_of_fans_rad_s(self, trajectories: Trajectories) -> Array:
        """(fans,) the same of each fan of the trajectories."""
        fans = len(trajectories.tacho)
        squares = np.bincount(trajectories.fan, np.sum(self.error_rad_s**2, axis=0), fans)
        return np.sqrt(squares / np.bincount(trajectories.fan, trajectories.compared.sum(axis=0), fans))


IterationDone = Callable[[int, Unknowns, float], bool]
"""Called with iteration, unknowns and rmse in rad/s after each accepted step; true stops the fit."""


def fit_free_run(
    model: FanOde,
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
        point, iteration, stopped = minimise(
            problem,
            problem.rescaled(point),
            max_iterations,
            tolerance=tolerance,
            accepted=accepted,
            iteration=iteration,
        )
        if stopped:
            break
    return FreeRunFit(point, problem.rmse_rad_s(point), point.residual / problem.errors.weight, iteration)


def fit_physics(
    model: FanOde,
    physics: Array,
    top_speed_rad_s: Array,
    trajectories: Trajectories,
    *,
    free: Flags,
    prior: Prior,
    part: str,
    progress: Progress,
) -> FreeRunFit:
    """Fit the physics of each fan alone; where a tacho counts, again with the errors of readings that this fit shows.

    part: the name of this work in reports of progress. The other arguments are those of fit_free_run.
    """

    def iteration_done(iteration: int, _unknowns: Unknowns, rmse_rad_s: float) -> bool:
        progress(part, iteration, MOST_ITERATIONS_OF_PHYSICS, rmse_rad_s)
        return False

    def fitted(start: Array, *, with_errors: bool) -> FreeRunFit:
        return fit_free_run(
            model,
            start,
            top_speed_rad_s,
            trajectories,
            free=free,
            prior=prior,
            max_iterations=MOST_ITERATIONS_OF_PHYSICS,
            with_errors=with_errors,
            iteration_done=iteration_done,
        )

    fit = fitted(physics, with_errors=False)
    if not counts(trajectories):
        return fit
    weighted = fitted(fit.point.unknowns.physics, with_errors=True)
    return replace(weighted, iterations=fit.iterations + weighted.iterations)
