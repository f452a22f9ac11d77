"""What the runs of each fan show of the error of its model: where they were, and how much each sample counts.

The error is a weighted sum of functions of speed and command (`Basis`). Filtered, it is what the model misses of the
speed (twin.fitting.filtering), and the squares of the filtered functions say how well the runs determine the weights.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fantwin.twin.evaluation.accuracy import evaluation_pieces
from fantwin.twin.fitting.filtering import Basis, filtered_regression, with_lagged_command
from fantwin.twin.fitting.trajectories import MAX_SAMPLES
from fantwin.twin.models.fan_ode import FanOde
from fantwin.twin.models.physics import LAG
from fantwin.twin.runs import Array, Run

HELD = 2.0
"""limit of `_relative_std`: a sample below it counts as held"""


@dataclass(frozen=True, eq=False)
class FanEvidence:
    """Evidence of one fan. squares: (C, C) of the filtered functions, relative to the variance of what the model
    misses. held_command: (m,) after the lag, of the samples in which the fan turned and was held, or just turned if it
    was never held; empty if it never turned.
    """

    squares: Array
    held_command: Array


def evidence_of_fans(
    model: FanOde,
    parameters: Array,
    runs: Sequence[Run],
    acting_runs: Sequence[Run],
    basis: Basis,
    lambda_per_s: float,
    least_noise_rad_s: float,
    stands_below_rad_s: float,
) -> list[FanEvidence]:
    """The evidence of each fan. parameters: (fans, 4). acting_runs: the runs with the commands that act on the fans.

    least_noise_rad_s: lower bound of what the model misses. stands_below_rad_s: speed below which a fan stands.
    """
    parts, acting = _parts(runs, parameters[:, LAG]), _parts(acting_runs, parameters[:, LAG])
    found: list[FanEvidence] = []
    for fan, own in enumerate(parameters):
        seen = [pair for pair in zip(parts, acting, strict=True) if np.isfinite(pair[0].speed_rad_s[:, fan]).sum() >= 2]
        acceleration = acceleration_of(model, own)
        missed, motion, speed, commands = (list[Array]() for _ in range(4))
        for part, driven in seen:
            target, explained = _regression(driven, fan, acceleration, lambda_per_s)
            known = np.isfinite(part.speed_rad_s[:, fan])
            missed.append(target - explained[:, 0])
            motion.append(target)
            speed.append(part.speed_rad_s[known, fan])
            commands.append(part.command[known, fan])
        turns = np.abs(_joined(speed)) > stands_below_rad_s
        std = _relative_std(_joined(missed), _joined(motion), turns, least_noise_rad_s)
        ends = np.cumsum([len(part) for part in missed])
        squares = np.zeros((len(basis(np.zeros(1), np.zeros(1))[0]),) * 2)
        for (part, _), of_part in zip(seen, np.split(std, ends[:-1]) if seen else (), strict=True):
            _, columns = _regression(part, fan, basis, lambda_per_s)
            columns /= of_part[:, np.newaxis]
            squares += columns.T @ columns
        held = turns & (std < HELD)
        noise = variance_of_independent(_joined(missed) / std) if seen else 0.0
        held_command = _joined(commands)[held if held.any() else turns]
        found.append(FanEvidence(squares / max(noise, least_noise_rad_s**2), held_command))
    return found


def acceleration_of(model: FanOde, parameters: Array) -> Basis:
    """The acceleration of one fan, rad/s^2. parameters: (4,)."""
    equation = model.equation(parameters[np.newaxis])

    def acceleration(speed_rad_s: Array, command: Array) -> Array:
        return equation.acceleration(speed_rad_s[:, np.newaxis], command[:, np.newaxis])

    return acceleration


def variance_of_independent(missed: Array) -> float:
    """The variance of independent samples whose mean would be as uncertain: that of slow noise is larger."""
    correlation = np.fft.irfft(np.abs(np.fft.rfft(missed, 2 * len(missed))) ** 2)[: len(missed)] / len(missed)
    negative = np.flatnonzero(correlation < 0.0)
    return float(correlation[0] + 2.0 * correlation[1 : negative[0] if len(negative) else None].sum())


def _joined(parts: Sequence[Array]) -> Array:
    return np.concatenate(parts) if parts else np.zeros(0)


def _parts(runs: Sequence[Run], lag_s: Array) -> list[Run]:
    """The runs with the commands after the lag, in parts that bound the memory for the filtered functions."""
    pieces = with_lagged_command(evaluation_pieces(runs), lag_s)
    return [piece.rows(first, end) for piece in pieces for first, end in piece.equal_parts(MAX_SAMPLES)]


def _regression(part: Run, fan: int, basis: Basis, lambda_per_s: float) -> tuple[Array, Array]:
    return filtered_regression(part.t_s, part.speed_rad_s[:, fan], part.command[:, fan], basis, lambda_per_s)


def _relative_std(missed: Array, motion_rad_s: Array, turns: NDArray[np.bool_], least_rad_s: float) -> Array:
    """(m,) the standard deviation of what a model misses at each sample, relative to that of the half that moves least.

    motion_rad_s: (m,) the distance of the speed from its low-pass, which is the target of the filtered regression.
    turns: (m,) of bool; how a fan that stands is missed says nothing about one that turns. least_rad_s: that standard
    deviation is not below.
    """
    if not turns.any():
        return np.ones(len(missed))
    motions, squares = np.square(motion_rad_s), np.square(missed)
    excess = np.maximum(motions - np.median(motions[turns]), 0.0)
    least = max(squares[turns & (excess == 0.0)].mean(), least_rad_s**2)
    is_moving = turns & (excess > 0.0)
    rise = float((squares[is_moving] - least).sum() / excess[is_moving].sum()) if is_moving.any() else 0.0
    return np.sqrt(1.0 + max(rise, 0.0) * excess / least)
