"""How far a twin may be wrong at each speed and command, because of what it has not seen.

What a model misses is taken for a Gaussian process over speed and command (Rasmussen and Williams, Gaussian Processes
for Machine Learning, chapter 2), smooth over a quarter of the recorded range. It is written as a sum of random cosines
(Rahimi and Recht, NeurIPS 2007), whose weights the runs determine by linear regression through the filtering operator
(twin.fitting.filtering). Their covariance after the runs gives the standard deviation of the acceleration that is left.
Held for long, an error of the acceleration becomes that error times the fan's time constant in the speed.

What the fans of a tray have in common is known from all of them. How one differs from them is such a process too, of a
smaller deviation, and known from its own runs alone. While a fan changes its speed a model misses more: what it passes
quickly says less than what it holds.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.linalg import cholesky, solve_triangular

from schemas.model_uncertainty import ModelUncertainty
from twin.evaluation.accuracy import evaluation_pieces
from twin.fitting.filtering import Basis, filtered_regression
from twin.fitting.identification import Identification
from twin.fitting.training import data_scaling
from twin.fitting.trajectories import MAX_SAMPLES
from twin.measurement import with_measured_command
from twin.models.lag import effective_command
from twin.models.model import OdeModel
from twin.models.network import Scaling
from twin.models.physics import LAG, acceleration_by_speed
from twin.runs import Array, Run

PRIOR_STD = 0.3
"""of the acceleration where nothing was recorded, in its scale: held for long, 0.15 of the range of speeds for a fan of
the typical time constant"""
OWN_VARIANCE = 1.0 / 9.0
"""share of the prior variance in which fans differ"""
LENGTH = 0.5
"""over which what the model misses changes, in half recorded ranges"""
COSINES, SEED = 400, 0
SPEEDS, REACH = 37, 1.5
"""of the table, and how far it reaches, in half recorded ranges"""
OFFSETS = (0.03, 0.1, 0.3, 1.0, 2.5)
"""of its commands from that at which a fan settles, in half recorded ranges: dense where fans nearly always are"""
SLOWEST = 3.0
"""time constants are limited to so many of the typical one: they grow without limit where a fan hardly turns"""
HELD = 2.0
"""times the standard deviation of what a model misses while a fan moves least: above it the fan is not held"""
STANDS_BELOW = 0.05
"""of half the recorded range of speeds"""
SEEN_QUANTILE = 0.9
"""of the standard deviations where a fan was held in training"""
LEAST_NOISE = 1e-4
"""of a reading, in half the recorded range of speeds: data without noise determine no more than numbers can hold"""


def model_uncertainty(
    model: OdeModel,
    parameters: Array,
    runs: Sequence[Run],
    acting_runs: Sequence[Run],
    identification: Identification,
) -> ModelUncertainty:
    """Of a trained model. parameters: (fans, 4). runs: those that it was trained on, with the commands of the table.
    acting_runs: the same with the commands that act on the fans.
    """
    scale = data_scaling(runs, identification)
    typical_s = float(np.median(identification.time_constant_s))
    basis = _cosines(scale)
    speeds_rad_s = scale.speed_offset_rad_s + scale.speed_scale_rad_s * np.linspace(-REACH, REACH, SPEEDS)
    offsets = scale.command_scale * np.array((*(-each for each in reversed(OFFSETS)), 0.0, *OFFSETS))
    shown = _shown_by_each_fan(model, parameters, runs, acting_runs, basis, 1.0 / typical_s, scale)
    settled = [
        _settled_command(model, own, speeds_rad_s, scale) + each.friction
        for own, each in zip(parameters, shown, strict=True)
    ]
    held_s = _held_s(parameters, speeds_rad_s, SLOWEST * typical_s)
    std_rad_s = [
        _left_rad_s2(root, basis, speeds_rad_s, commands[:, np.newaxis] + offsets) * held_s[:, fan, np.newaxis]
        for fan, (commands, root) in enumerate(zip(settled, _roots([each.squares for each in shown]), strict=True))
    ]
    table = ModelUncertainty(
        tuple(np.round(speeds_rad_s, 4).tolist()),
        tuple(np.round(offsets, 6).tolist()),
        tuple(tuple(map(tuple, np.round(each, 3).tolist())) for each in std_rad_s),
        settled_command=tuple(map(tuple, np.round(settled, 6).tolist())),
    )
    seen = tuple(
        _seen_std_rad_s(table.of_fans([fan]), each.held_command, commands, STANDS_BELOW * scale.speed_scale_rad_s)
        for fan, (each, commands) in enumerate(zip(shown, settled, strict=True))
    )
    return replace(table, seen_std_rad_s=seen)


def _seen_std_rad_s(
    table: ModelUncertainty, held_command: Array, settled_command: Array, stands_below_rad_s: float
) -> float:
    """Of one fan, where its twin settles, and turns, at the commands at which it was held."""
    speed_rad_s = np.interp(held_command, settled_command, table.speeds_rad_s)
    std_rad_s = table.std_at(speed_rad_s, held_command)[np.abs(speed_rad_s) > stands_below_rad_s]
    return round(float(np.quantile(std_rad_s, SEEN_QUANTILE)), 4) if std_rad_s.size else 0.0


def _settled_command(model: OdeModel, own: Array, speeds_rad_s: Array, scale: Scaling) -> Array:
    """(n,) the commands that, as they act, hold a fan at speeds, as far as the table reaches."""
    commands = scale.command_offset + scale.command_scale * np.linspace(-2.0 * REACH, 2.0 * REACH, 1000)
    speed_rad_s, command = (values.ravel() for values in np.meshgrid(speeds_rad_s, commands, indexing="ij"))
    acceleration = _acceleration(model, own)(speed_rad_s, command).reshape(len(speeds_rad_s), -1)
    rising = np.maximum.accumulate(acceleration, axis=1)
    return np.array([np.interp(0.0, of_speed, commands) for of_speed in rising])


def _left_rad_s2(root: Array, basis: Basis, speeds_rad_s: Array, commands: Array) -> Array:
    """(speeds, commands) the standard deviation of the acceleration. commands: (speeds, commands) at each speed."""
    values = basis(np.repeat(speeds_rad_s, commands.shape[1]), commands.ravel())
    return np.linalg.norm(solve_triangular(root, values.T, lower=True), axis=0).reshape(commands.shape)


def _held_s(parameters: Array, speed_rad_s: Array, slowest_s: float) -> Array:
    """(n, fans) the time constants of their physics, none longer than the slowest."""
    by_speed_per_s = acceleration_by_speed(speed_rad_s[:, np.newaxis], parameters)
    return -1.0 / np.minimum(by_speed_per_s, -1.0 / slowest_s)


def _roots(squares: Sequence[Array]) -> Iterator[Array]:
    """(C, C) of each fan: the lower Cholesky factor of the information about the sum of what the fans have in common
    and what is its own. squares: (C, C) of each fan, of its runs.
    """
    prior = np.eye(COSINES) / (1.0 - OWN_VARIANCE)
    of_common = [_of_others(each) for each in squares]
    for number, each in enumerate(squares):
        others = sum((its for other, its in enumerate(of_common) if other != number), prior)
        yield cholesky(_of_others(others) + each, lower=True)


def _of_others(information: Array) -> Array:
    """(C, C) what information about some fans is worth to one that differs from them."""
    values, vectors = np.linalg.eigh(information)
    values = np.maximum(values, 0.0)
    return (vectors * (values / (1.0 + OWN_VARIANCE * values))) @ vectors.T


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


class _Shown(NamedTuple):
    """What its runs show of a fan."""

    squares: Array
    """(C, C) of the filtered cosines, relative to the variance of what the model misses"""
    held_command: Array
    """(m, 1) after the lag, where it turned and was held"""
    friction: float
    """what a drive takes of the command before it acts"""


def _shown_by_each_fan(
    model: OdeModel,
    parameters: Array,
    runs: Sequence[Run],
    acting_runs: Sequence[Run],
    basis: Basis,
    lambda_per_s: float,
    scale: Scaling,
) -> list[_Shown]:
    """Of each fan.

    Runs are processed in parts, so that memory does not grow with them.
    """
    least, stands_below_rad_s = (LEAST_NOISE * scale.speed_scale_rad_s) ** 2, STANDS_BELOW * scale.speed_scale_rad_s
    commands, acting = (
        [_lagged(piece, parameters[:, LAG]) for piece in evaluation_pieces(each)] for each in (runs, acting_runs)
    )
    pieces = list(zip(evaluation_pieces(runs), commands, acting, strict=True))
    found = []
    for fan, own in enumerate(parameters):
        measured = [
            (run.t_s[part], run.speed_rad_s[part, fan], command[part, fan], acts[part, fan])
            for run, command, acts in pieces
            for part in (slice(first, end) for first, end in run.equal_parts(MAX_SAMPLES))
            if np.isfinite(run.speed_rad_s[part, fan]).sum() >= 2
        ]
        squares = np.zeros((COSINES, COSINES))
        if not measured:
            found.append(_Shown(squares, np.zeros((0, 1)), 0.0))
            continue
        equation = _acceleration(model, own)
        both = [filtered_regression(t_s, speed, acts, equation, lambda_per_s) for t_s, speed, _, acts in measured]
        missed = np.concatenate([target - explained[:, 0] for target, explained in both])
        std = _relative_std(missed, np.concatenate([target for target, _ in both]))
        first = 0
        for t_s, speed, command, _ in measured:
            _, cosines = filtered_regression(t_s, speed, command, basis, lambda_per_s)
            cosines /= std[first : (first := first + len(cosines)), np.newaxis]
            squares += cosines.T @ cosines
        squares /= max(variance_of_independent(missed / std), least)
        speed_rad_s, command, acts = (
            np.concatenate([each[column][np.isfinite(each[1])] for each in measured]) for column in (1, 2, 3)
        )
        held = (std < HELD) & (np.abs(speed_rad_s) > stands_below_rad_s)
        friction = float(np.median((command - acts)[held])) if held.any() else 0.0
        found.append(_Shown(squares, command[held, np.newaxis], friction))
    return found


def _relative_std(missed: Array, motion_rad_s: Array) -> Array:
    """(m,) the standard deviation of what a model misses at each sample, relative to that of the half that moves least.

    motion_rad_s: (m,) the distance of the speed from its low-pass, which is the target of the filtered regression.
    """
    motions, squares = np.square(motion_rad_s), np.square(missed)
    excess = np.maximum(motions - np.median(motions), 0.0)
    is_moving = excess > 0.0
    least = squares[~is_moving].mean()
    if least <= 0.0 or not is_moving.any():
        return np.ones(len(missed))
    rise = max(float((squares[is_moving] - least).sum() / excess.sum()), 0.0)
    return np.sqrt(1.0 + rise * excess / least)


def _lagged(piece: Run, lag_s: Array) -> Array:
    """(n, fans) the command as the tachos show it, after the lag."""
    shown = with_measured_command(piece)
    return effective_command(shown.command, shown.step_s[:, np.newaxis], lag_s, shown.command[0])[0]


def _acceleration(model: OdeModel, parameters: Array) -> Basis:
    equation = model.equation(parameters[np.newaxis])

    def acceleration(speed_rad_s: Array, command: Array) -> Array:
        return equation.acceleration(speed_rad_s[:, np.newaxis], command[:, np.newaxis])

    return acceleration


def variance_of_independent(missed: Array) -> float:
    """The variance of independent samples whose mean would be as uncertain: that of slow noise is larger."""
    correlation = np.fft.irfft(np.abs(np.fft.rfft(missed, 2 * len(missed))) ** 2)[: len(missed)] / len(missed)
    negative = np.flatnonzero(correlation < 0.0)
    return float(correlation[0] + 2.0 * correlation[1 : negative[0] if len(negative) else None].sum())
