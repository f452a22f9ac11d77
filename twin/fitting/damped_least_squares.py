"""Levenberg-Marquardt for any sum of losses whose normal equations a problem can give.

More, The Levenberg-Marquardt algorithm, LNM 630 (1978): a Gauss-Newton step damped by the diagonal of the normal
equations. A step that lowers the cost is taken and the damping divided by `DAMPING_DOWN`; otherwise the damping is
multiplied by `DAMPING_UP` and the step is tried again.

A problem may consist of *groups* of unknowns that share nothing, such as the physics of each fan. Each group is damped,
accepted and stopped by itself, as if it were fitted alone.
"""

from collections.abc import Callable
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from fantwin.twin.runs import Array

HUBER_DELTA = 3.0
DAMPING_DOWN, DAMPING_UP = 3.0, 4.0
FIRST_DAMPING, SMALLEST_DAMPING, LARGEST_DAMPING = 1e-3, 1e-9, 1e9

P = TypeVar("P")
Flags = NDArray[np.bool_]


class LeastSquaresProblem(Protocol[P]):
    """What the loop needs of a problem. P: a candidate, with all that was computed of it."""

    groups: int

    def total(self, point: P, /) -> Array:
        """(groups,) the cost of a candidate; infinite where it cannot be computed."""
        ...

    def normal_equations(self, point: P, /) -> tuple[Array, Array]:
        """The curvature and the descent direction of the cost, in the problem's own layout."""
        ...

    def trial(self, point: P, squares: Array, gradient: Array, damping: Array, /) -> P:
        """The candidate one damped Gauss-Newton step away. damping: (groups,)."""
        ...

    def merge(self, old: P, new: P, take_new: Flags, /) -> P:
        """The new candidate for the groups that take it, the old one for the others."""
        ...


def minimise(
    problem: LeastSquaresProblem[P],
    point: P,
    max_iterations: int,
    tolerance: float,
    accepted: Callable[[int, P], bool],
    iteration: int = 0,
) -> tuple[P, int, bool]:
    """The next minimum, the iterations with those before, and whether the fit was stopped.

    It ends where a step lowers the cost by less than `tolerance`, relative, or where no step lowers it. accepted: is
    called with iteration and candidate after each step that lowers a cost; true stops the fit. iteration: those done
    before, which count.
    """
    damping = np.full(problem.groups, FIRST_DAMPING)
    cost = problem.total(point)
    active = np.isfinite(cost)
    normal: tuple[Array, Array] | None = None
    while iteration < max_iterations and np.any(active):
        iteration += 1
        normal = problem.normal_equations(point) if normal is None else normal
        trial = problem.trial(point, *normal, damping)
        trial_cost = problem.total(trial)
        better = active & (trial_cost < cost)
        gain = np.zeros(problem.groups)
        gain[better] = (cost[better] - trial_cost[better]) / cost[better]
        damping = np.where(better, np.maximum(damping / DAMPING_DOWN, SMALLEST_DAMPING), damping * DAMPING_UP)
        active &= ~(better & (gain < tolerance)) & (damping < LARGEST_DAMPING)
        if not np.any(better):
            continue
        point, cost, normal = problem.merge(point, trial, better), np.where(better, trial_cost, cost), None
        if accepted(iteration, point):
            return point, iteration, True
    return point, iteration, iteration >= max_iterations


def pseudo_huber(residual: Array, scale: Array | float) -> Array:
    """The loss of each residual: half its square in units of `scale`, and linear beyond `HUBER_DELTA` of them."""
    return HUBER_DELTA**2 * (np.hypot(1.0, residual / (HUBER_DELTA * scale)) - 1.0)


def pseudo_huber_weight(residual: Array, scale: Array | float) -> Array:
    """How much each residual counts in the normal equations of `pseudo_huber`: 1 for small ones."""
    return 1.0 / np.hypot(1.0, residual / (HUBER_DELTA * scale))
