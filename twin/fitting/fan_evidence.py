"""What the runs of each fan show of the error of its model: where they were, and how much each sample counts.

The error is a weighted sum of functions of speed and command (`Basis`). Filtered, it is what the model misses of the
speed (twin.fitting.filtering), and the squares of the filtered functions say how well the runs determine the weights.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fantwin.twin.evaluation.accuracy import evaluation_pieces
from fantwin.twin.fitting.filtering import Basis, filtered_regression
from fantwin.twin.fitting.trajectories import MAX_SAMPLES
from fantwin.twin.measurement import with_measured_command
from fantwin.twin.models.fan_ode import FanOde
from fantwin.twin.models.lag import effective_command
from fantwin.twin.models.physics import LAG
from fantwin.twin.runs import Array, Run

HELD = 2.0
"""limit of `_relative_std`: a sample below it counts as held"""


@dataclass(frozen=True, eq=False)
class FanEvidence:
    """Of one fan. squares: (C, C) of the filtered functions, relative to the variance of what the model misses.
    held_command: (m,) after the lag, of the samples in which the fan turned and was held, or turned at least; empty if
    it never did. friction: what a drive takes of the command before it acts.
    """

    squares: Array
    held_command: Array
    friction: float


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
    """Of each fan. parameters: (fans, 4). acting_runs: the runs with the commands that act on the fans.

    least_noise_rad_s: what the model misses is not taken for less. stands_below_rad_s: at such speeds a fan stands.
    """
    sizes = len(basis(np.zeros(1), np.zeros(1))[0])
    found: list[FanEvidence] = []
    missed, motion, speed, acting = (_columns(len(parameters)) for _ in range(4))
    for fan, t_s, speed_rad_s, command in _measured(acting_runs, parameters):
        target, explained = filtered_regression(
            t_s, speed_rad_s, command, acceleration_of(model, parameters[fan]), lambda_per_s
        )
        known = np.isfinite(speed_rad_s)
        for column, values in (
            (missed, target - explained[:, 0]),
            (motion, target),
            (speed, speed_rad_s[known]),
            (acting, command[known]),
        ):
            column[fan].append(values)
    turns = [np.abs(_joined(of)) > stands_below_rad_s for of in speed]
    std = [
        _relative_std(_joined(its), _joined(moved), turned, least_noise_rad_s)
        for its, moved, turned in zip(missed, motion, turns, strict=True)
    ]
    squares, command_of = np.zeros((len(parameters), sizes, sizes)), _columns(len(parameters))
    first = [0] * len(parameters)
    for fan, t_s, speed_rad_s, command in _measured(runs, parameters):
        _, columns = filtered_regression(t_s, speed_rad_s, command, basis, lambda_per_s)
        part = slice(first[fan], first[fan] + len(columns))
        columns /= std[fan][part, np.newaxis]
        squares[fan] += columns.T @ columns
        command_of[fan].append(command[np.isfinite(speed_rad_s)])
        first[fan] = part.stop
    for fan, turned in enumerate(turns):
        command = _joined(command_of[fan])
        held = turned & (std[fan] < HELD)
        held = held if held.any() else turned
        noise = variance_of_independent(_joined(missed[fan]) / std[fan]) if len(command) else 0.0
        friction = float(np.median((command - _joined(acting[fan]))[held])) if held.any() else 0.0
        found.append(FanEvidence(squares[fan] / max(noise, least_noise_rad_s**2), command[held], friction))
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


def _columns(fans: int) -> list[list[Array]]:
    return [[] for _ in range(fans)]


def _joined(parts: Sequence[Array]) -> Array:
    return np.concatenate(parts) if parts else np.zeros(0)


def _measured(runs: Sequence[Run], parameters: Array) -> Iterator[tuple[int, Array, Array, Array]]:
    """Fan, times, speeds and commands after the lag of the parts of runs in which a fan was measured: (n,) each.

    Parts bound the memory for the filtered functions, however long the runs are.
    """
    for run in evaluation_pieces(runs):
        command = _lagged(run, parameters[:, LAG])
        for first, end in run.equal_parts(MAX_SAMPLES):
            part = slice(first, end)
            for fan in range(len(parameters)):
                if np.isfinite(run.speed_rad_s[part, fan]).sum() >= 2:
                    yield fan, run.t_s[part], run.speed_rad_s[part, fan], command[part, fan]


def _lagged(piece: Run, lag_s: Array) -> Array:
    """(n, fans) the command as the tachos show it, after the lag."""
    shown = with_measured_command(piece)
    return effective_command(shown.command, shown.step_s[:, np.newaxis], lag_s, shown.command[0])[0]


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
