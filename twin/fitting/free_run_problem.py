"""The errors of a free run as a sum of losses, its normal equations and their damped steps: see free_run_fit."""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from fantwin.twin.fitting.damped_least_squares import Flags, pseudo_huber, pseudo_huber_weight
from fantwin.twin.fitting.reading_errors import ReadingErrors, counts, reading_errors, robust_scale
from fantwin.twin.fitting.trajectories import Trajectories
from fantwin.twin.models.fan_ode import FanOde
from fantwin.twin.models.integration import free_run, free_run_sensitivities
from fantwin.twin.models.lag import effective_command, effective_command_by_lag
from fantwin.twin.models.network import TanhNetwork
from fantwin.twin.models.physical import parameters_by_unknowns, physical_parameters
from fantwin.twin.models.physics import LAG, PARAMETER_NAMES
from fantwin.twin.models.right_hand_side import FanEquation
from fantwin.twin.runs import Array

FAST_CHUNK_NUMBERS, MAX_CHUNK_NUMBERS = 500_000, 4_000_000
ALIGNED_COLUMNS = 16  # of fast chunks: whole registers, so that all columns of a chunk are summed alike
HELD = 1e12

ALL_FREE = np.ones(len(PARAMETER_NAMES), dtype=bool)
OF_STEADY_SPEEDS = np.array([name in ("alpha", "C_D") for name in PARAMETER_NAMES])
INERTIA = PARAMETER_NAMES.index("J")
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
        by_theta = np.empty((len(self.speed_rad_s), network.parameter_count))
        value, _, _ = network.linearise(self.speed_rad_s, self.command, by_theta)
        return self.weight * by_theta.T @ by_theta, self.weight * by_theta.T @ (self.acceleration_rad_s2 - value)


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
    network: NetworkPrior | None = None
    limits_steps: bool = False


NO_PRIOR = Prior(0.0, np.zeros(1), np.zeros(1))


@dataclass(frozen=True, eq=False)
class Point:
    """A candidate: its free run; the residual of its readings (n, batch), each less its expected error and times its
    weight (ReadingErrors), zero where nothing is compared; and its cost (fans,) without the prior.
    """

    unknowns: Unknowns
    speed_rad_s: Array
    residual: Array
    cost: Array


@dataclass(eq=False)
class FreeRunProblem:
    """The sum of losses and its normal equations for one set of trajectories.

    top_speed_rad_s: (fans,). free: (4,) or (fans, 4), the physics unknowns that are fitted. estimate_initial_speed:
    otherwise the first measured speeds are used, as in operation; an unstable equilibrium then cannot be hidden by an
    initial speed that happens to lie on it. scale_rad_s, errors: what is known of the errors so far.
    """

    model: FanOde
    trajectories: Trajectories
    top_speed_rad_s: Array
    free: Flags = field(default_factory=NONE_FREE.copy)
    prior: Prior = NO_PRIOR
    estimate_initial_speed: bool = True

    def __post_init__(self) -> None:
        self.fans, self.weights = len(self.top_speed_rad_s), len(self.model.theta)
        self.groups = 1 if self.weights else self.fans
        self.group_of_fan = np.zeros(self.fans, dtype=np.intp) if self.weights else np.arange(self.fans)
        self.scale_rad_s = np.ones(self.fans)
        self.errors = ReadingErrors.unknown(self.trajectories.command.shape)

    def point(self, weights: Array, physics: Array) -> Point:
        """The candidate with these unknowns whose free runs start from the first measured speeds."""
        data = self.trajectories
        unknowns = Unknowns(weights, physics, data.starting_speed_rad_s())
        return self.evaluate(unknowns, data.interpolated_speed_rad_s())

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
            loss = pseudo_huber(residual, scale).sum(axis=0)
            cost = np.bincount(data.fan, loss, self.fans).astype(np.float64)
        cost[~np.isfinite(cost)] = np.inf
        return Point(unknowns, speed, residual, cost)

    def rescaled(self, point: Point) -> Point:
        """The candidate with residuals in units of what they scatter by in its own free run."""
        self.scale_rad_s = robust_scale(point.residual, self.trajectories)
        return self.evaluate(point.unknowns, point.speed_rad_s)

    def learn_errors(self, point: Point) -> None:
        """Let readings have the errors that they have in the free run of this candidate."""
        data = self.trajectories
        heavier = replace(point.unknowns, physics=point.unknowns.physics.copy())
        heavier.physics[:, INERTIA] += HEAVIER
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
        batch, size = len(data.fan), self.weights + point.unknowns.physics.shape[1] + 1
        squares, gradient = np.empty((batch, size, size)), np.empty((batch, size))
        for part in self.parts():
            sensitivity = self.sensitivities(point, part).transpose(1, 0, 2)
            scale = self.scale_rad_s[data.fan[part]]
            weight = self.sample_weights(point.residual[:, part], part) / scale**2
            weighted = sensitivity * weight.T[:, :, np.newaxis]
            squares[part] = weighted.transpose(0, 2, 1) @ sensitivity
            gradient[part] = np.einsum("bnp,nb->bp", weighted, point.residual[:, part])
        return squares, gradient

    def parts(self) -> Iterator[slice]:
        """The trajectories that are differentiated at once: with as many derivatives as a cache holds, or where these
        are of few trajectories, as many as memory should."""
        steps, batch = self.trajectories.command.shape
        numbers = steps * (self.weights + self.free.shape[-1] + 1)
        fast = FAST_CHUNK_NUMBERS // numbers // ALIGNED_COLUMNS * ALIGNED_COLUMNS
        width = fast or max(1, MAX_CHUNK_NUMBERS // numbers)
        return (slice(first, first + width) for first in range(0, batch, width))

    def sample_weights(self, residual: Array, part: slice) -> Array:
        """(n, batch) the pseudo-Huber loss's weights: 1 for small residuals, 0 where nothing is compared."""
        data = self.trajectories
        weight = pseudo_huber_weight(residual, self.scale_rad_s[data.fan[part]])
        return np.where(data.compared[:, part], weight, 0.0)

    def sensitivities(self, point: Point, part: slice) -> Array:
        """(n, batch, M) derivatives of the free run's readings by weights, physics unknowns and initial speed, each
        times its weight.
        """
        data, unknowns = self.trajectories, point.unknowns
        equation, command = self.equation(unknowns, part)
        by_command = self.command_by_unknowns(unknowns, part)
        raw = free_run_sensitivities(equation, point.speed_rad_s[:, part], command, data.step_s[:, part], by_command)
        if equation.parameters is None:
            unused = np.zeros((*command.shape, LAG))
            raw = np.concatenate((raw[..., : self.weights], unused, raw[..., -2:]), axis=-1)
        else:
            chain = self.parameters_by_unknowns(unknowns)[data.fan[part]]
            raw[..., self.weights : -1] = np.einsum("nbp,bpq->nbq", raw[..., self.weights : -1], chain)
        readings = data.measurement.of_speed(raw, part)
        if counts(data):
            readings *= self.errors.weight[:, part, np.newaxis]
        return readings

    def command_by_unknowns(self, unknowns: Unknowns, part: slice) -> Array:
        """(n, batch, K) derivatives of the command that acts by the last K physics unknowns: by the lag."""
        data = self.trajectories
        lag_s = unknowns.physics[data.fan[part], LAG]
        if not np.any(lag_s):
            return self._by_lag_of_zero[:, part, np.newaxis]
        step_s, before = data.step_s[:, part], data.command_before[part]
        return effective_command_by_lag(data.command[:, part], step_s, lag_s, before)[..., np.newaxis]

    def parameters_by_unknowns(self, unknowns: Unknowns) -> Array:
        """(fans, 4, 4) derivatives of the physical parameters by the physics unknowns."""
        return parameters_by_unknowns(unknowns.physics, self.top_speed_rad_s)

    @cached_property
    def _by_lag_of_zero(self) -> Array:
        """(n, batch) effective_command_by_lag where there is no lag."""
        data = self.trajectories
        return effective_command_by_lag(data.command, data.step_s, np.zeros(len(data.fan)), data.command_before)

    def trial(self, point: Point, squares: Array, gradient: Array, damping: Array) -> Point:
        """See damped_least_squares."""
        return self.evaluate(self.step(point, squares, gradient, damping), point.speed_rad_s)

    def step(self, point: Point, squares: Array, gradient: Array, damping: Array) -> Unknowns:
        """The damped Gauss-Newton step: initial speeds eliminated first, then each fan's physics, then the weights."""
        fan_of, unknowns = self.trajectories.fan, point.unknowns
        damping_of_fan = damping[self.group_of_fan]
        # An initial speed that is not estimated gets infinite curvature, so that it does not change.
        known = 1.0 if self.estimate_initial_speed else np.inf
        by_initial = known * squares[:, -1, -1] * (1.0 + damping_of_fan[fan_of])
        own, coupling = without_initial_speeds(squares, by_initial)
        reduced = sums_by_fan(own, fan_of, self.fans)
        downhill = sums_by_fan(gradient[:, :-1] - coupling * gradient[:, -1:], fan_of, self.fans)
        diagonal = sums_by_fan(np.diagonal(squares[:, :-1, :-1], axis1=1, axis2=2), fan_of, self.fans)

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
        return Unknowns(
            unknowns.weights + move,
            self.within_bounds(unknowns.physics + physics_move),
            unknowns.initial_speed_rad_s + initial_move,
        )

    def within_bounds(self, physics: Array) -> Array:
        """The nearest physics unknowns that are possible: no lag is negative."""
        physics[:, LAG] = np.maximum(physics[:, LAG], 0.0)
        return physics

    def at_bounds(self, physics: Array, downhill: Array) -> Flags:
        """(fans, 4) which physics unknowns would leave their bounds: a lag of zero that would decrease further."""
        held = np.zeros(physics.shape, np.bool_)
        held[:, LAG] = (physics[:, LAG] <= 0.0) & (downhill[:, LAG] <= 0.0)
        return held

    def _network(self, weights: Array) -> TanhNetwork:
        network = self.model.network
        assert network is not None, "a prior on a network needs a network"
        return network.with_theta(weights)

    def _physics_pivot(
        self, unknowns: Unknowns, reduced: Array, downhill: Array, diagonal: Array, damping: Array
    ) -> Array:
        """(fans, 4, 4) the damped curvature of the physics unknowns; a very large one for those that are fixed."""
        held = ~self.free | self.at_bounds(unknowns.physics, downhill)
        largest = diagonal.max(axis=1, keepdims=True) + 1.0
        # An unknown without any effect still needs a pivot: the floor keeps the system solvable and the step zero.
        ridge = damping[:, None] * diagonal + self.prior.physics + 1e-12 * largest + np.where(held, HELD * largest, 0.0)
        pivot = reduced.copy()
        every = np.arange(ridge.shape[1])
        pivot[:, every, every] += ridge
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


def without_initial_speeds(squares: Array, by_initial: Array) -> tuple[Array, Array]:
    """(batch, M - 1, M - 1) of squares (batch, M, M), with the initial speed of each, the last unknown, eliminated.

    Beside it (batch, M - 1) how the initial speed follows the others. by_initial: (batch,) the curvature by it.
    """
    coupling = squares[:, :-1, -1] / by_initial[:, np.newaxis]
    return squares[:, :-1, :-1] - coupling[:, :, None] * squares[:, None, :-1, -1], coupling


def sums_by_fan(values: Array, fan: NDArray[np.intp], fans: int) -> Array:
    """(fans, ...) the sums of values (batch, ...) over the trajectories of each fan, in their order."""
    total = np.zeros((fans, *values.shape[1:]))
    order = np.argsort(fan, kind="stable")
    number = np.empty_like(order)
    number[order] = np.arange(len(fan)) - np.searchsorted(fan[order], fan[order])
    for count in range(int(number.max()) + 1):
        chosen = np.flatnonzero(number == count)
        total[fan[chosen]] += values[chosen]
    return total
