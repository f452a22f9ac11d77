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

Without shared weights every fan is damped, accepted and stopped by itself, as if it were fitted alone.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from twin.fitting.reading_errors import ReadingErrors, counts, reading_errors, robust_scale
from twin.fitting.trajectories import Trajectories
from twin.models.integration import free_run, free_run_sensitivities
from twin.models.lag import effective_command, effective_command_by_lag
from twin.models.model import OdeModel
from twin.models.network import TanhNetwork
from twin.models.physical import parameters_by_unknowns, physical_parameters
from twin.models.physics import LAG, PARAMETER_NAMES
from twin.models.right_hand_side import FanEquation
from twin.runs import Array

Flags = NDArray[np.bool_]

HUBER_DELTA = 3.0
SCALE_ROUNDS, ERROR_ROUNDS = 2, 4  # with a constant scale, or with what was learned of the errors of readings
FAST_CHUNK_NUMBERS, MAX_CHUNK_NUMBERS = 500_000, 4_000_000
ALIGNED_COLUMNS = 16  # of fast chunks: sums over the units of a network are the same to the bit however they are cut
DAMPING_DOWN, DAMPING_UP = 3.0, 4.0
FIRST_DAMPING, SMALLEST_DAMPING, LARGEST_DAMPING = 1e-3, 1e-9, 1e9
HELD = 1e12

ALL_FREE = np.ones(len(PARAMETER_NAMES), dtype=bool)
OF_STEADY_SPEEDS = np.array([name in ("alpha", "C_D") for name in PARAMETER_NAMES])
OF_INERTIA = np.array([name == "J" for name in PARAMETER_NAMES])
HEAVIER = 0.1  # of ln J: by what its errors in motion are found
NONE_FREE = np.zeros(len(PARAMETER_NAMES), dtype=bool)


@dataclass(frozen=True, eq=False)
class Unknowns:
    """weights: (P,), empty without a network. physics: (fans, 4), see twin.models.physical. initial_speed_rad_s:
    (batch,)."""

    weights: Array
    physics: Array
    initial_speed_rad_s: Array


@dataclass(frozen=True, eq=False)
class Prior:
    """Quadratic pulls, in units of squared scaled residuals: weights towards zero, the physics towards
    physics_mean.

    physics: (4,). physics_mean: (fans, 4). network: pulls the acceleration of the network towards a
    given one where there are no data, or None. limits_steps: the damping of a step counts the pulls on the weights like
    the data. Without, a weight of which the data show nothing goes all the way at once, however large the damping, and
    a fit from a good start may find no step that is better.
    """

    weights: float
    physics: Array
    physics_mean: Array
    network: "NetworkPrior | None" = None
    limits_steps: bool = False


@dataclass(frozen=True, eq=False)
class NetworkPrior:
    """Virtual observations of the network: at speed_rad_s and command (k,) it gives acceleration_rad_s2 (k,).

    weight: of each, 1 / (its standard deviation in rad/s^2)^2.
    """

    speed_rad_s: Array
    command: Array
    acceleration_rad_s2: Array
    weight: float

    def cost(self, network: TanhNetwork) -> float:
        """Half the weighted sum of squares."""
        error = self.acceleration_rad_s2 - network.acceleration(self.speed_rad_s, self.command)
        return 0.5 * self.weight * float(error @ error)

    def normal_equations(self, network: TanhNetwork) -> tuple[Array, Array]:
        """Their share of the Hessian (P, P) and of the descent direction (P,)."""
        value, _, _, by_theta = network.linearise(self.speed_rad_s, self.command)
        return self.weight * by_theta.T @ by_theta, self.weight * by_theta.T @ (self.acceleration_rad_s2 - value)


@dataclass(frozen=True, eq=False)
class Point:
    """A candidate: its free run; the residual of its readings (n, batch), each less its expected error and times its
    weight (ReadingErrors), zero where nothing is compared; and its cost (fans,) without the prior.
    """

    unknowns: Unknowns
    speed_rad_s: Array
    residual: Array
    cost: Array


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
        point, iteration, stopped = _descend(problem, point, iteration, max_iterations, tolerance, iteration_done)
        if stopped:
            break
    return FreeRunFit(point, problem.rmse_rad_s(point), point.residual / problem.errors.weight, iteration)


def _descend(
    problem: "FreeRunProblem",
    point: Point,
    iteration: int,
    max_iterations: int,
    tolerance: float,
    iteration_done: IterationDone | None,
) -> tuple[Point, int, bool]:
    """Iterate to the next minimum with a constant scale. Also returns whether it was stopped."""
    groups = problem.groups
    damping = np.full(groups, FIRST_DAMPING)
    cost = problem.total(point)
    active = np.isfinite(cost)
    normal: tuple[Array, Array] | None = None
    while iteration < max_iterations and np.any(active):
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
        if iteration_done is not None and iteration_done(iteration, point.unknowns, problem.rmse_rad_s(point)):
            return point, iteration, True
    return point, iteration, iteration >= max_iterations


class FreeRunProblem:
    """The sum of losses and its normal equations for one set of trajectories."""

    def __init__(
        self,
        model: OdeModel,
        trajectories: Trajectories,
        top_speed_rad_s: Array,
        free: Flags,
        prior: Prior,
        estimate_initial_speed: bool = True,
    ) -> None:
        self.model = model
        self.trajectories = trajectories
        self.top_speed_rad_s = top_speed_rad_s
        self.free = free
        self.prior = prior
        self.estimate_initial_speed = estimate_initial_speed
        self.fans = len(top_speed_rad_s)
        self.weights = len(model.theta)
        self.groups = 1 if self.weights else self.fans
        self.group_of_fan = np.zeros(self.fans, dtype=np.intp) if self.weights else np.arange(self.fans)
        self.scale_rad_s = np.ones(self.fans)
        self.errors = ReadingErrors.unknown(trajectories.command.shape)

    def evaluate(self, unknowns: Unknowns, guess_rad_s: Array) -> Point:
        """The free run of these unknowns. guess_rad_s: (n, batch), speeds nearby."""
        data = self.trajectories
        equation, command = self.equation(unknowns, slice(None))
        guess = np.where(np.isfinite(guess_rad_s), guess_rad_s, 0.0)
        speed, _ = free_run(equation, unknowns.initial_speed_rad_s, command, data.step_s, guess)
        scale = self.scale_rad_s[data.fan]
        with np.errstate(over="ignore", invalid="ignore"):
            error = data.speed_rad_s - data.measurement.of_speed(speed) - self.errors.expected_rad_s
            residual = np.where(data.compared, self.errors.weight * error, 0.0)
            loss = HUBER_DELTA**2 * (np.hypot(1.0, residual / (HUBER_DELTA * scale)) - 1.0)
            cost = np.bincount(data.fan, loss.sum(axis=0), self.fans).astype(np.float64)
        cost[~np.isfinite(cost)] = np.inf
        return Point(unknowns, speed, residual, cost)

    def learn_errors(self, point: Point) -> None:
        """Let readings have the errors that they have in the free run of this candidate."""
        data = self.trajectories
        heavier = replace(point.unknowns, physics=point.unknowns.physics + HEAVIER * OF_INERTIA)
        readings = data.measurement.of_speed(point.speed_rad_s)
        of_heavier = data.measurement.of_speed(self.evaluate(heavier, point.speed_rad_s).speed_rad_s)
        with np.errstate(over="ignore", invalid="ignore"):
            errors, by_inertia = data.speed_rad_s - readings, of_heavier - readings
        self.errors = reading_errors(errors, point.speed_rad_s, by_inertia, data, self.errors)

    def equation(self, unknowns: Unknowns, part: slice) -> tuple[FanEquation, Array]:
        """The equation of some trajectories, and the command that acts on them (n, batch)."""
        data = self.trajectories
        parameters = self.parameters(unknowns)[data.fan[part]]
        command, _ = effective_command(
            data.command[:, part], data.step_s[:, part], parameters[:, LAG], data.command_before[part]
        )
        return self.model.with_theta(unknowns.weights).equation(parameters), command

    def parameters(self, unknowns: Unknowns) -> Array:
        """(fans, 4) physical parameters."""
        return physical_parameters(unknowns.physics, self.top_speed_rad_s)

    def total(self, point: Point) -> Array:
        """(groups,) cost with the prior."""
        physics = 0.5 * np.sum(self.prior.physics * (point.unknowns.physics - self.prior.physics_mean) ** 2, axis=1)
        total = np.bincount(self.group_of_fan, point.cost + physics, self.groups).astype(np.float64)
        weights = point.unknowns.weights
        if self.prior.network is not None:
            total = total + self.prior.network.cost(self._network(weights))
        return total + 0.5 * self.prior.weights * float(weights @ weights)

    def normal_equations(self, point: Point) -> tuple[Array, Array]:
        """For each trajectory the weighted S^T S (batch, M, M) and S^T residual (batch, M).

        The unknowns are in the order weights, physics, initial speed.
        """
        data = self.trajectories
        steps, batch = data.command.shape
        size = self.weights + len(PARAMETER_NAMES) + 1
        squares, gradient = np.empty((batch, size, size)), np.empty((batch, size))
        width = _chunk_columns(steps * size)
        for first in range(0, batch, width):
            part = slice(first, first + width)
            sensitivity = self.sensitivities(point, part).transpose(1, 0, 2)
            scale = self.scale_rad_s[data.fan[part]]
            weight = self.sample_weights(point.residual[:, part], part) / scale**2
            weighted = sensitivity * weight.T[:, :, np.newaxis]
            squares[part] = weighted.transpose(0, 2, 1) @ sensitivity
            gradient[part] = np.einsum("bnp,nb->bp", weighted, point.residual[:, part])
        return squares, gradient

    def sample_weights(self, residual: Array, part: slice) -> Array:
        """(n, batch) the pseudo-Huber loss's weights: 1 for small residuals, 0 where nothing is compared."""
        data = self.trajectories
        scaled = residual / self.scale_rad_s[data.fan[part]]
        return np.where(data.compared[:, part], 1.0 / np.hypot(1.0, scaled / HUBER_DELTA), 0.0)

    def sensitivities(self, point: Point, part: slice) -> Array:
        """(n, batch, M) derivatives of the free run's readings by weights, physics unknowns and initial speed, each
        times its weight.
        """
        data = self.trajectories
        fan, step_s = data.fan[part], data.step_s[:, part]
        parameters = self.parameters(point.unknowns)[fan]
        equation, command = self.equation(point.unknowns, part)
        by_lag = effective_command_by_lag(data.command[:, part], step_s, parameters[:, LAG], data.command_before[part])
        raw = free_run_sensitivities(equation, point.speed_rad_s[:, part], command, step_s, by_lag)
        by_parameters = np.zeros((*command.shape, len(PARAMETER_NAMES)))
        by_parameters[..., LAG] = raw[..., -2]
        if equation.parameters is not None:
            by_parameters[..., :LAG] = raw[..., self.weights : -2]
        chain = parameters_by_unknowns(point.unknowns.physics, self.top_speed_rad_s)[fan]
        by_own = np.einsum("nbp,bpq->nbq", by_parameters, chain)
        sensitivities = np.concatenate((raw[..., : self.weights], by_own, raw[..., -1:]), axis=-1)
        return data.measurement.of_speed(sensitivities, part) * self.errors.weight[:, part, np.newaxis]

    def step(self, point: Point, squares: Array, gradient: Array, damping: Array) -> Unknowns:
        """The damped Gauss-Newton step: initial speeds eliminated first, then each fan's physics, then the weights."""
        fan_of, unknowns = self.trajectories.fan, point.unknowns
        damping_of_fan = damping[self.group_of_fan]
        # An initial speed that is not estimated gets infinite curvature, so that it does not change.
        known = 1.0 if self.estimate_initial_speed else np.inf
        by_initial = known * squares[:, -1, -1] * (1.0 + damping_of_fan[fan_of])
        coupling = squares[:, :-1, -1] / by_initial[:, np.newaxis]
        reduced = np.zeros((self.fans, *squares[0, :-1, :-1].shape))
        downhill = np.zeros((self.fans, reduced.shape[-1]))
        diagonal = np.zeros_like(downhill)
        np.add.at(reduced, fan_of, squares[:, :-1, :-1] - coupling[:, :, None] * squares[:, None, :-1, -1])
        np.add.at(downhill, fan_of, gradient[:, :-1] - coupling * gradient[:, -1:])
        np.add.at(diagonal, fan_of, np.diagonal(squares[:, :-1, :-1], axis1=1, axis2=2))

        weights, physics = slice(self.weights), slice(self.weights, None)
        pivot = self._physics_pivot(
            unknowns, reduced[:, physics, physics], downhill[:, physics], diagonal[:, physics], damping_of_fan
        )
        downhill[:, physics] -= self.prior.physics * (unknowns.physics - self.prior.physics_mean)
        shared = np.linalg.solve(
            pivot, np.concatenate((reduced[:, physics, weights], downhill[:, physics, None]), axis=-1)
        )
        share, alone = shared[..., :-1], shared[..., -1]
        move = np.zeros(self.weights)
        if self.weights:
            of_weights = diagonal[:, weights].sum(axis=0)
            hessian = np.sum(reduced[:, weights, weights] - reduced[:, weights, physics] @ share, axis=0)
            slope = np.sum(downhill[:, weights] - np.einsum("fwo,fo->fw", reduced[:, weights, physics], alone), axis=0)
            if self.prior.network is not None:
                squares_of_prior, slope_of_prior = self.prior.network.normal_equations(self._network(unknowns.weights))
                hessian += squares_of_prior
                slope += slope_of_prior
                if self.prior.limits_steps:
                    of_weights += np.diagonal(squares_of_prior) + self.prior.weights
            floor = 1e-12 * of_weights.max() + np.finfo(float).tiny
            hessian[np.diag_indices(self.weights)] += damping[0] * of_weights + self.prior.weights + floor
            move = np.linalg.solve(hessian, slope - self.prior.weights * unknowns.weights)
        physics_move = np.where(self.free, alone - share @ move, 0.0)
        whole = np.concatenate((np.broadcast_to(move, (self.fans, self.weights)), physics_move), axis=1)
        initial_move = gradient[:, -1] / by_initial - np.sum(coupling * whole[fan_of], axis=1)
        new_physics = unknowns.physics + physics_move
        new_physics[:, LAG] = np.maximum(new_physics[:, LAG], 0.0)
        return Unknowns(unknowns.weights + move, new_physics, unknowns.initial_speed_rad_s + initial_move)

    def _network(self, weights: Array) -> TanhNetwork:
        network = self.model.network
        assert network is not None, "a prior on a network needs a network"
        return network.with_theta(weights)

    def _physics_pivot(
        self, unknowns: Unknowns, reduced: Array, downhill: Array, diagonal: Array, damping: Array
    ) -> Array:
        """(fans, 4, 4) the damped curvature of the physics unknowns; a very large one for those that are fixed."""
        held = np.broadcast_to(~self.free, diagonal.shape).copy()
        # A lag of zero that would decrease further stays at zero.
        held[:, LAG] |= (unknowns.physics[:, LAG] <= 0.0) & (downhill[:, LAG] <= 0.0)
        largest = diagonal.max(axis=1, keepdims=True) + 1.0
        # An unknown without any effect still needs a pivot: the floor keeps the system solvable and the step zero.
        ridge = damping[:, None] * diagonal + self.prior.physics + 1e-12 * largest + np.where(held, HELD * largest, 0.0)
        pivot = reduced.copy()
        pivot[:, np.arange(len(PARAMETER_NAMES)), np.arange(len(PARAMETER_NAMES))] += ridge
        return pivot

    def merge(self, old: Point, new: Point, take_new: Flags) -> Point:
        """The new point for the groups that take it, the old one for the others."""
        if np.all(take_new):
            return new
        fan = take_new[self.group_of_fan]
        column = fan[self.trajectories.fan]
        unknowns = Unknowns(
            weights=new.unknowns.weights,
            physics=np.where(fan[:, np.newaxis], new.unknowns.physics, old.unknowns.physics),
            initial_speed_rad_s=np.where(column, new.unknowns.initial_speed_rad_s, old.unknowns.initial_speed_rad_s),
        )
        return replace(
            new,
            unknowns=unknowns,
            speed_rad_s=np.where(column, new.speed_rad_s, old.speed_rad_s),
            residual=np.where(column, new.residual, old.residual),
            cost=np.where(fan, new.cost, old.cost),
        )

    def rmse_rad_s(self, point: Point) -> float:
        """Root mean square of the errors of all samples that are compared, whatever their weight."""
        compared = self.trajectories.compared
        with np.errstate(over="ignore"):
            error_rad_s = np.where(compared, point.residual / self.errors.weight + self.errors.expected_rad_s, 0.0)
            return float(np.sqrt(np.sum(error_rad_s**2) / np.count_nonzero(compared)))


def _chunk_columns(numbers: int) -> int:
    """How many trajectories are differentiated at once, each with so many derivatives: as many as a cache holds, or
    where that is few, as many as memory should."""
    fast = FAST_CHUNK_NUMBERS // numbers // ALIGNED_COLUMNS * ALIGNED_COLUMNS
    return fast or max(1, MAX_CHUNK_NUMBERS // numbers)
