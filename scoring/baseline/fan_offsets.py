"""Mean healthy residual of each fan at each speed, beyond the baseline of a run.

A twin has a small error for each fan at each speed, largest where it had little training data. The error is the same on
all days, so several runs show it, and limits need not allow for it. The mean residual of fan f in run r and speed bin b
is modelled as e_fb + c_fr, where c is the baseline of that day; both by least squares. e is then shrunk towards the
mean of all fans, by an amount that follows from its variance between fans and the remaining variance between runs
(empirical Bayes: Efron and Morris, JASA 70 (1975) 311).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from schemas.messages import Array
from scoring.baseline.healthy_residual import FanOffsets

MIN_FANS = 3
MIN_RUNS = 12
"""of a fan: with fewer, the offsets contain too much of single days, which limits set on the same runs cannot show"""
MIN_LONG_RUNS, LONG_S = 3, 4 * 3600.0
"""or so many in which a fan was scored for so long: in a night it meets each speed again and again"""
MIN_S, FULL_S = 3.0, 30.0  # of one run in a speed bin: to count at all, and to count fully
ROUNDS = 20
DIGITS = 4
MIN_WEIGHT = 1e-12


@dataclass(frozen=True, eq=False)
class Cells:
    """Sums of one run's residual less its baseline. known_as: the numbers of its fans. count, total: (fans, bins)."""

    known_as: range
    count: Array
    total: Array


def fan_offsets(runs: Sequence[Cells], centres_rad_s: Array, period_s: float) -> FanOffsets | None:
    """The offsets of all fans; None if there are too few fans or runs. centres_rad_s: (bins,)."""
    numbers = np.array([number for run in runs for number in run.known_as], int)
    if len(set(numbers.tolist())) < MIN_FANS:
        return None
    count = np.concatenate([run.count for run in runs])
    is_long = count.sum(axis=1) * period_s >= LONG_S
    if np.bincount(numbers).max() < MIN_RUNS and np.bincount(numbers, is_long).max() < MIN_LONG_RUNS:
        return None
    mean = np.concatenate([run.total for run in runs]) / np.maximum(count, 1.0)
    seconds = count * period_s
    weight = np.where(seconds >= MIN_S, np.minimum(seconds / FULL_S, 1.0), 0.0)
    weights = _by_fan(weight, numbers)
    seen = weights.sum(axis=0) > 0.0
    if not seen.any():
        return None
    offset = mean_offset = np.zeros_like(weights)
    for _ in range(ROUNDS):
        day = _mean(weight, mean - offset[numbers])
        offset = _by_fan(weight * (mean - day), numbers) / np.maximum(weights, MIN_WEIGHT)
        mean_offset = (weights * offset).sum(axis=0) / np.maximum(weights.sum(axis=0), MIN_WEIGHT)
        offset = offset - _mean(weights, offset - mean_offset)  # an offset at all speeds alike belongs to the baseline
    day = _mean(weight, mean - offset[numbers])
    rest = (weight * np.square(mean - day - offset[numbers])).sum()
    parameters = (
        np.count_nonzero(weights) + np.count_nonzero(weight.any(axis=1)) - np.count_nonzero(weights.any(axis=1))
    )
    between_runs = rest / max(np.count_nonzero(weight) - parameters, 1)
    expected_by_chance = (weights > 0).sum(axis=0) * between_runs
    variance = ((weights * np.square(offset - mean_offset)).sum(axis=0) - expected_by_chance) / np.maximum(
        weights.sum(axis=0), MIN_WEIGHT
    )
    variance = np.maximum(variance, 0.0)
    shrinkage = variance / np.maximum(variance + between_runs / np.maximum(weights, MIN_WEIGHT), MIN_WEIGHT)
    shrunk = mean_offset + shrinkage * (offset - mean_offset)
    return FanOffsets(
        speeds_rad_s=tuple(centres_rad_s[seen].tolist()),
        offset_sigmas=tuple(tuple(row) for row in np.round(shrunk[:, seen], DIGITS).tolist()),
    )


def _by_fan(values: Array, numbers: Array) -> Array:
    """(fans, bins) sums over the runs of each fan."""
    sums = np.zeros((numbers.max() + 1, values.shape[1]))
    np.add.at(sums, numbers, values)
    return sums


def _mean(weight: Array, values: Array) -> Array:
    """(rows, 1) over bins."""
    return ((weight * values).sum(axis=1) / np.maximum(weight.sum(axis=1), MIN_WEIGHT))[:, np.newaxis]
