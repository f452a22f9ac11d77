"""Levenberg-Marquardt on the free-run error, with exact sensitivities.

Minimises the sum of a pseudo-Huber loss of (reading - that of the free run) / scale over every sample that is compared;
if asked, with what is known of the errors of readings (twin.fitting.reading_errors). What the tachos are expected
to show of a free run is linear in it (twin.tacho_readings), and so in its sensitivities. The unknowns are

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
from functools import partial

from fantwin.twin.fitting.damped_least_squares import minimise
from fantwin.twin.fitting.free_run_problem import OF_STEADY_SPEEDS, FreeRunProblem, Point, Unknowns
from fantwin.twin.fitting.reading_errors import counts
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


IterationDone = Callable[[int, Unknowns, float], bool]
"""Called with iteration, unknowns and rmse in rad/s after each accepted step; true stops the fit."""


def fit_free_run(
    problem: FreeRunProblem,
    physics: Array,
    *,
    max_iterations: int,
    tolerance: float = 1e-5,
    with_errors: bool = False,
    iteration_done: IterationDone | None = None,
) -> FreeRunFit:
    """Fit the weights of the model, where it has any, starting from its own, and the free ones of the physics unknowns.

    physics: (fans, 4) to start from. with_errors: readings of tachos that count are taken with the errors that they
    have in the free run of each round (twin.fitting.reading_errors); inertia and lag are held, for what shows them then
    counts little. It stops when a step lowers the cost by less than tolerance, relative, or when none lowers it.
    """

    def accepted(iteration: int, point: Point) -> bool:
        return iteration_done is not None and iteration_done(iteration, point.unknowns, problem.rmse_rad_s(point))

    point, iteration = problem.point(problem.model.theta, physics), 0
    learns_errors = with_errors and counts(problem.trajectories)
    if learns_errors:
        problem.free = problem.free & OF_STEADY_SPEEDS
    for _ in range(ERROR_ROUNDS if learns_errors else SCALE_ROUNDS):
        if learns_errors:
            problem.learn_errors(point)
            point = problem.evaluate(point.unknowns, point.speed_rad_s)
        point, iteration, stopped = minimise(
            problem, problem.rescaled(point), max_iterations, tolerance, accepted, iteration
        )
        if stopped:
            break
    return FreeRunFit(point, problem.rmse_rad_s(point), point.residual / problem.errors.weight, iteration)


def fit_physics(problem: FreeRunProblem, physics: Array, part: str, progress: Progress) -> FreeRunFit:
    """Fit the physics of each fan alone; where a tacho counts, again with the errors of readings that this fit shows.

    physics: (fans, 4) to start from. part: the name of this work in reports of progress.
    """

    def iteration_done(iteration: int, _unknowns: Unknowns, rmse_rad_s: float) -> bool:
        progress(part, iteration, MOST_ITERATIONS_OF_PHYSICS, rmse_rad_s)
        return False

    fitted = partial(fit_free_run, max_iterations=MOST_ITERATIONS_OF_PHYSICS, iteration_done=iteration_done)
    fit = fitted(problem, physics)
    if not counts(problem.trajectories):
        return fit
    weighted = fitted(problem, fit.point.unknowns.physics, with_errors=True)
    return replace(weighted, iterations=fit.iterations + weighted.iterations)
