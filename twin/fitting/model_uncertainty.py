"""How far a twin may be wrong at each speed and command, because of what it has not seen.

What a model misses is taken for a Gaussian process over speed and command (Rasmussen and Williams, Gaussian Processes
for Machine Learning, chapter 2), smooth over a quarter of the recorded range. It is written as a sum of random cosines
(Rahimi and Recht, NeurIPS 2007), whose weights the runs determine by linear regression through the filtering operator
(twin.fitting.filtering). Their covariance after the runs gives the standard deviation of the acceleration that is left.
Held for long, an error of the acceleration becomes that error times the fan's time constant in the speed.

The fans of a tray are taken together: what one of them has shown is known of all.
"""

from collections.abc import Sequence
from dataclasses import replace

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
LENGTH = 0.5
"""over which what the model misses changes, in half recorded ranges"""
COSINES, SEED = 400, 0
POINTS, REACH = 13, 1.5
"""of the table along each axis, and how far it reaches, in half recorded ranges"""
SLOWEST = 3.0
"""time constants are limited to so many of the typical one: they grow without limit where a fan hardly turns"""
SEEN_QUANTILE = 0.95
"""of the standard deviations at the samples of training"""
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
    information = np.eye(COSINES)
    least = (LEAST_NOISE * scale.speed_scale_rad_s) ** 2
    for missed, squares in _of_each_fan(model, parameters, runs, acting_runs, basis, 1.0 / typical_s):
        information += squares / max(variance_of_independent(missed), least)
    root = cholesky(information, lower=True)
    side = np.linspace(-REACH, REACH, POINTS)
    speeds_rad_s = scale.speed_offset_rad_s + scale.speed_scale_rad_s * side
    commands = scale.command_offset + scale.command_scale * side
    speed_rad_s, command = (values.ravel() for values in np.meshgrid(speeds_rad_s, commands, indexing="ij"))
    values = basis(speed_rad_s, command)
    std_rad_s2 = np.linalg.norm(solve_triangular(root, values.T, lower=True), axis=0)
    held_s = _held_s(parameters, speed_rad_s, SLOWEST * typical_s)
    std_rad_s = (std_rad_s2 * held_s).reshape(POINTS, POINTS)
    table = ModelUncertainty(
        tuple(speeds_rad_s.tolist()), tuple(commands.tolist()), tuple(map(tuple, np.round(std_rad_s, 4).tolist()))
    )
    seen_rad_s = np.concatenate([table.std_at(run.speed_rad_s, run.command).ravel() for run in runs])
    return replace(table, seen_std_rad_s=round(float(np.nanquantile(seen_rad_s, SEEN_QUANTILE)), 4))


def _held_s(parameters: Array, speed_rad_s: Array, slowest_s: float) -> Array:
    """(n,) mean over the fans of the time constants of their physics, none longer than the slowest."""
    by_speed_per_s = acceleration_by_speed(speed_rad_s[:, np.newaxis], parameters)
    return (-1.0 / np.minimum(by_speed_per_s, -1.0 / slowest_s)).mean(axis=1)


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


def _of_each_fan(
    model: OdeModel,
    parameters: Array,
    runs: Sequence[Run],
    acting_runs: Sequence[Run],
    basis: Basis,
    lambda_per_s: float,
) -> list[tuple[Array, Array]]:
    """Of each fan what the model misses (m,), and the squares of the cosines (C, C), filtered.

    Runs are processed in parts, so that memory does not grow with them.
    """
    missed: list[list[Array]] = [[] for _ in parameters]
    squares = np.zeros((len(parameters), COSINES, COSINES))
    for run, acting_run in zip(evaluation_pieces(runs), evaluation_pieces(acting_runs), strict=True):
        command, acting = (_lagged(piece, parameters[:, LAG]) for piece in (run, acting_run))
        for first, end in run.equal_parts(MAX_SAMPLES):
            part = slice(first, end)
            for fan, own in enumerate(parameters):
                t_s, speed_rad_s = run.t_s[part], run.speed_rad_s[part, fan]
                if np.isfinite(speed_rad_s).sum() < 2:
                    continue
                known = _acceleration(model, own)
                target, explained = filtered_regression(t_s, speed_rad_s, acting[part, fan], known, lambda_per_s)
                _, cosines = filtered_regression(t_s, speed_rad_s, command[part, fan], basis, lambda_per_s)
                missed[fan].append(target - explained[:, 0])
                squares[fan] += cosines.T @ cosines
    return [(np.concatenate(of), squares[fan]) for fan, of in enumerate(missed) if of]


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
