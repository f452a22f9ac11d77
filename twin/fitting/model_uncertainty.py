"""How far a twin may be wrong at each speed and command, because of what it has not seen.

What a model misses is taken for a Gaussian process over speed and command (Rasmussen and Williams, Gaussian Processes
for Machine Learning, chapter 2), smooth over a quarter of the recorded range. It is written as a sum of random cosines
(Rahimi and Recht, NeurIPS 2007), whose weights the runs determine by linear regression through the filtering operator
(twin.fitting.filtering). Their covariance after the runs gives the standard deviation of the acceleration that is left.
Held for long, an error of the acceleration becomes that error times the fan's time constant in the speed.

The error of a fan is the sum of a part that all fans of the twin have in common, known from the runs of all, and a
part of that fan alone, known from its own runs only. Errors are larger while a fan changes its speed, so samples in
motion get less weight than held ones.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
from scipy.linalg import cholesky, get_lapack_funcs, solve_triangular

from fantwin.schemas.model_uncertainty import ModelUncertainty
from fantwin.twin.evaluation.accuracy import evaluation_pieces
from fantwin.twin.fitting.fan_evidence import FanEvidence, evidence_of_fans
from fantwin.twin.fitting.filtering import Basis
from fantwin.twin.fitting.identification import Identification
from fantwin.twin.fitting.training import data_scaling
from fantwin.twin.fitting.trajectories import coarser, thinning_factor
from fantwin.twin.models.fan_ode import FanOde
from fantwin.twin.models.network import Scaling
from fantwin.twin.models.physical import fitted_unknowns, physical_parameters
from fantwin.twin.models.physics import acceleration, acceleration_by_speed
from fantwin.twin.runs import Array, Run

(dpotri,) = get_lapack_funcs(("potri",), dtype=np.float64)

PRIOR_STD = 0.3
"""of the acceleration where nothing was recorded, in its scale: held for long, 0.15 of the range of speeds for a fan of
the typical time constant"""
OWN_VARIANCE = 1.0 / 9.0
"""share of the prior variance that belongs to each fan alone"""
LENGTH = 0.5
"""over which what the model misses changes, in half recorded ranges"""
COSINES, SEED = 400, 0
REACH, EVEN_COMMANDS, HELD_COMMANDS, APART = 1.5, 25, 40, 0.005
"""of the table: how far its commands reach; so many evenly, and at most so many where fans were held; the least between
two of them. Reach and distance in half recorded ranges"""
OFFSETS = (0.03, 0.1, 0.3, 1.0, 2.5)
"""of its speeds from that at which a fan settles, in half recorded ranges: dense where fans nearly always are"""
SLOWEST = 3.0
"""time constants are limited to so many of the typical one: they grow without limit where a fan hardly turns"""
STANDS_BELOW = 0.05
"""of half the recorded range of speeds"""
SEEN_QUANTILE = 0.9
"""of the standard deviations where a fan was held in training"""
LEAST_NOISE = 1e-4
"""of a reading, in half the recorded range of speeds: data without noise determine no more than numbers can hold"""
SETTLING_SPEEDS = 2000
"""points at which the acceleration is taken, to find where it is zero"""


def model_uncertainty(
    model: FanOde,
    parameters: Array,
    runs: Sequence[Run],
    acting_runs: Sequence[Run],
    friction: Array,
    identification: Identification,
) -> ModelUncertainty:
    """The uncertainty of a trained model. parameters: (fans, 4). runs: its training runs, with the commands of the
    table. acting_runs: the same with the commands that act on the fans. friction: (fans,) what a drive takes off the
    command before it acts.
    """
    scale = data_scaling(runs, identification)
    typical_s = float(np.median(identification.time_constant_s))
    basis = _cosines(scale)
    least_rad_s, stands_below_rad_s = (share * scale.speed_scale_rad_s for share in (LEAST_NOISE, STANDS_BELOW))
    if thinning_factor(evaluation_pieces(runs), float(identification.time_constant_s.max())) > 1:
        runs, acting_runs = (
            [coarser(piece, typical_s) for piece in evaluation_pieces(of)] for of in (runs, acting_runs)
        )
    evidence = evidence_of_fans(
        model, parameters, runs, acting_runs, basis, 1.0 / typical_s, least_rad_s, stands_below_rad_s
    )
    commands = _commands(evidence, scale)
    offsets_rad_s = scale.speed_scale_rad_s * np.array((*(-each for each in reversed(OFFSETS)), 0.0, *OFFSETS))
    reach = np.linspace(-2.0 * REACH, 2.0 * REACH, SETTLING_SPEEDS)
    reach_rad_s = scale.speed_offset_rad_s + scale.speed_scale_rad_s * reach
    settled_rad_s, std_rad_s = _settled_rad_s(model, commands, reach_rad_s, parameters, friction), []
    roots = _roots([each.squares for each in evidence])
    for own, settled, root in zip(parameters, settled_rad_s, roots, strict=True):
        speeds_rad_s = settled[:, np.newaxis] + offsets_rad_s
        held_s = _held_s(own, speeds_rad_s, SLOWEST * typical_s)
        std_rad_s.append(_left_rad_s2(root, basis, speeds_rad_s, commands) * held_s)
    table = ModelUncertainty(
        significant(offsets_rad_s),
        significant(commands),
        significant(np.array(std_rad_s), 4),
        seen_std_rad_s=(0.0,) * len(std_rad_s),  # found below
        settled_speed_rad_s=significant(settled_rad_s),
    )
    seen_rad_s = [
        _seen_std_rad_s(table.of_fans([fan]), its.held_command, settled, stands_below_rad_s)
        for fan, (its, settled) in enumerate(zip(evidence, settled_rad_s, strict=True))
    ]
    of_others = max((each for each in seen_rad_s if each is not None), default=0.0)
    return replace(table, seen_std_rad_s=tuple(of_others if each is None else each for each in seen_rad_s))


def significant(values: Array, digits: int = 7) -> tuple[Any, ...]:
    """Values with so many significant digits, row by row: commands and speeds may be of any size."""
    if values.ndim > 1:
        return tuple(significant(row, digits) for row in values)
    return tuple(float(f"{value:.{digits}g}") for value in values.tolist())


def _commands(evidence: Sequence[FanEvidence], scale: Scaling) -> Array:
    """(n,) rising: even ones as far as the table reaches, and those at which fans were held most."""
    even = scale.command_offset + scale.command_scale * np.linspace(-REACH, REACH, EVEN_COMMANDS)
    held = np.concatenate([each.held_command for each in evidence])
    if held.size:
        shares = (np.arange(HELD_COMMANDS) + 0.5) / HELD_COMMANDS
        held = np.quantile(held, shares, method="inverted_cdf")
    kept: list[float] = []
    for command in sorted({*even.tolist(), *held.tolist()}):
        if not kept or command - kept[-1] >= APART * scale.command_scale:
            kept.append(command)
    return np.array(kept)


def _seen_std_rad_s(
    table: ModelUncertainty, held_command: Array, settled_rad_s: Array, stands_below_rad_s: float
) -> float | None:
    """SEEN_QUANTILE of the standard deviations of one fan, rad/s, over the commands at which it was held, each at the
    speed at which its twin settles; standstill is left out. None if nothing is left.
    """
    speed_rad_s = np.interp(held_command, table.commands, settled_rad_s)
    turns = np.abs(speed_rad_s) > stands_below_rad_s
    if not turns.any():
        return None
    std_rad_s = table.std_at(speed_rad_s[turns, np.newaxis], held_command[turns, np.newaxis])
    return float(f"{np.quantile(std_rad_s, SEEN_QUANTILE):.4g}")


def _settled_rad_s(model: FanOde, commands: Array, speeds_rad_s: Array, parameters: Array, friction: Array) -> Array:
    """(fans, commands) the speeds at which fans with one network settle, between the given ones, which rise.

    parameters: (fans, 4). friction: (fans,) what a drive takes off the command before it acts.
    """

    @lru_cache(maxsize=1)
    def of_network(lost: float) -> tuple[Array, Array, Array | float]:
        """Speed, acting command and the acceleration that the network gives, for each pair of the two."""
        command, speed_rad_s = (each.ravel() for each in np.meshgrid(commands - lost, speeds_rad_s, indexing="ij"))
        network = model.network
        return speed_rad_s, command, 0.0 if network is None else network.acceleration(speed_rad_s, command)

    settled = []
    for own, lost in zip(parameters, friction.tolist(), strict=True):
        speed_rad_s, command, learned = of_network(lost)
        known = acceleration(speed_rad_s[:, np.newaxis], command[:, np.newaxis], own[np.newaxis])[:, 0]
        braking = -np.minimum.accumulate((learned + known).reshape(len(commands), -1), axis=1)
        settled.append([np.interp(0.0, of_command, speeds_rad_s) for of_command in braking])
    return np.array(settled)


def _left_rad_s2(root: Array, basis: Basis, speeds_rad_s: Array, commands: Array) -> Array:
    """(commands, speeds) the standard deviation of the acceleration. speeds_rad_s: (commands, speeds) at each."""
    values = basis(speeds_rad_s.ravel(), np.repeat(commands, speeds_rad_s.shape[1]))
    return np.linalg.norm(solve_triangular(root, values.T, lower=True), axis=0).reshape(speeds_rad_s.shape)


def _held_s(own: Array, speeds_rad_s: Array, slowest_s: float) -> Array:
    """As speeds_rad_s: the time constants of the physics of one fan, none longer than the slowest."""
    by_speed_per_s = acceleration_by_speed(speeds_rad_s.reshape(-1, 1), own[np.newaxis])
    return (-1.0 / np.minimum(by_speed_per_s, -1.0 / slowest_s)).reshape(speeds_rad_s.shape)


def _roots(squares: Sequence[Array]) -> Iterator[Array]:
    """(C, C) of each fan: the lower Cholesky factor of the information about the sum of what the fans have in common
    and what is its own. squares: (C, C) of each fan, of its runs.
    """
    prior = np.eye(COSINES) / (1.0 - OWN_VARIANCE)
    of_common = [_loosened(each) for each in squares]
    of_all = sum(of_common, np.zeros_like(prior))
    for each, its in zip(squares, of_common, strict=True):
        yield cholesky(_loosened(prior + (of_all - its)) + each, lower=True)


def _loosened(information: Array) -> Array:
    """(C, C) the information that is left where a part of variance OWN_VARIANCE is added: (information^-1 +
    OWN_VARIANCE)^-1. That of a fan about what is common, and that of all the others about a fan.
    """
    # The same as (1 - (1 + OWN_VARIANCE information)^-1) / OWN_VARIANCE, which exists where nothing is known.
    one = np.eye(len(information))
    below, _ = dpotri(cholesky(one + OWN_VARIANCE * information, lower=True), lower=1)
    return (one - (np.tril(below) + np.tril(below, -1).T)) / OWN_VARIANCE


def _cosines(scale: Scaling) -> Basis:
    """The cosines in rad/s^2, each of the same variance, together of the prior one."""
    rng = np.random.default_rng(SEED)
    directions = rng.normal(0.0, 1.0 / LENGTH, (2, COSINES))
    phases = rng.uniform(0.0, 2.0 * np.pi, COSINES)
    size = PRIOR_STD * scale.acceleration_scale_rad_s2 * np.sqrt(2.0 / COSINES)

    def basis(speed_rad_s: Array, command: Array) -> Array:
        speed = (speed_rad_s - scale.speed_offset_rad_s) / scale.speed_scale_rad_s
        commands = (command - scale.command_offset) / scale.command_scale
        return size * np.cos(np.outer(speed, directions[0]) + np.outer(commands, directions[1]) + phases)

    return basis


SETTLES_TO = 1.5
"""how far fans may settle, in top speeds of the type"""


def placed_uncertainty(
    of_type: ModelUncertainty,
    model: FanOde,
    parameters: Array,
    covariance: Array,
    top_speed_rad_s: float,
    friction: Array,
) -> ModelUncertainty:
    """How far the twin of placed fans may be wrong at each speed and command.

    Where the fans of its type were trained, the error is theirs: the largest of them, for a fan that was never seen. To
    it comes what is not known of the fan's own physics, as an error of the speed at which it settles.

    Returns their tables. parameters: (fans, 4). covariance: (fans, 4, 4) of their unknowns. friction: (fans,)
    what a drive takes of the command before it acts.
    """
    speeds_rad_s = SETTLES_TO * top_speed_rad_s * np.linspace(-1.0, 1.0, SETTLING_SPEEDS)
    commands, largest = np.array(of_type.commands), np.max(np.array(of_type.std_rad_s), axis=0)
    cases = [(own, *_moved(own, its, top_speed_rad_s)) for own, its in zip(parameters, covariance, strict=True)]
    of_all = np.repeat(friction, len(cases[0]))
    settled = _settled_rad_s(model, commands, speeds_rad_s, np.concatenate(cases), of_all)
    settled = settled.reshape(len(parameters), -1, len(commands))
    unknown_rad_s = np.sqrt(np.sum(np.square(settled[:, 1:] - settled[:, :1]), axis=1))
    seen = max(of_type.seen_std_rad_s, default=0.0)
    return replace(
        of_type,
        std_rad_s=significant(np.hypot(largest, unknown_rad_s[:, :, np.newaxis]), 4),
        settled_speed_rad_s=significant(settled[:, 0]),
        seen_std_rad_s=(seen,) * len(parameters),
    )


def _moved(own: Array, covariance: Array, top_speed_rad_s: float) -> Array:
    """(4, 4) the physics with the unknowns moved by one standard deviation, along each axis of their covariance."""
    top = np.full(len(own), top_speed_rad_s)
    variances, axes = np.linalg.eigh(covariance)
    moves = np.sqrt(np.maximum(variances, 0.0))[:, np.newaxis] * axes.T
    return physical_parameters(fitted_unknowns(np.tile(own, (len(own), 1)), top) + moves, top)
