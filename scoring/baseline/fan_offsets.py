"""What each fan's healthy residual is at each speed, beyond what a baseline of one run takes away.

A twin is wrong by another little at each speed, and of each fan: most where it was hardly trained. That stays from day
to day, so several runs show it, and then it need not be allowed for in limits. The mean residual of fan f in run r and
bin of speed b is taken as e_fb + c_fr, where c is that day's baseline; both by least squares. How far e is drawn
towards the mean of all fans follows from how much it varies between fans, and the rest between runs (empirical Bayes:
Efron and Morris, JASA 70 (1975) 311).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from schemas.messages import Array
from scoring.healthy_residual import FanOffsets

FEWEST_FANS = 3
FEWEST_RUNS = 12
"""of a fan: what is learned from a run is off by that day, and limits are set by the same runs, which do not see it"""
LEAST_S, WHOLE_S = 3.0, 30.0  # of one run in a bin of speed, to count at all, and to count as a whole one
ROUNDS = 20
DIGITS = 4
LEAST = 1e-12


@dataclass(frozen=True, eq=False)
class Cells:
    """Of one run: sums of a residual less its baseline. known_as: numbers of its fans. count, total: (fans, bins)."""

    known_as: range
    count: Array
    total: Array


def fan_offsets(runs: Sequence[Cells], centres_rad_s: Array, step_s: float) -> FanOffsets | None:
    """Of all fans known; None where fans or runs are too few. centres_rad_s: (bins,)."""
    numbers = np.array([number for run in runs for number in run.known_as], int)
    if len(set(numbers.tolist())) < FEWEST_FANS or np.bincount(numbers).max() < FEWEST_RUNS:
        return None
    count = np.concatenate([run.count for run in runs])
    mean = np.concatenate([run.total for run in runs]) / np.maximum(count, 1.0)
    seconds = count * step_s
    weight = np.where(seconds >= LEAST_S, np.minimum(seconds / WHOLE_S, 1.0), 0.0)
    runs_of = _by_fan(weight, numbers)
    seen = runs_of.sum(axis=0) > 0.0
    if not seen.any():
        return None
    own = of_all = np.zeros_like(runs_of)
    for _ in range(ROUNDS):
        of_day = _mean(weight, mean - own[numbers])
        own = _by_fan(weight * (mean - of_day), numbers) / np.maximum(runs_of, LEAST)
        of_all = (runs_of * own).sum(axis=0) / np.maximum(runs_of.sum(axis=0), LEAST)
        own = own - _mean(runs_of, own - of_all)  # what a fan is off by at all speeds alike is its baseline's
    of_day = _mean(weight, mean - own[numbers])
    left_over = (weight * np.square(mean - of_day - own[numbers])).sum()
    parameters = (
        np.count_nonzero(runs_of) + np.count_nonzero(weight.any(axis=1)) - np.count_nonzero(runs_of.any(axis=1))
    )
    between_runs = left_over / max(np.count_nonzero(weight) - parameters, 1)
    by_chance = (runs_of > 0).sum(axis=0) * between_runs
    varies = ((runs_of * np.square(own - of_all)).sum(axis=0) - by_chance) / np.maximum(runs_of.sum(axis=0), LEAST)
    varies = np.maximum(varies, 0.0)
    trusted = varies / np.maximum(varies + between_runs / np.maximum(runs_of, LEAST), LEAST)
    drawn = of_all + trusted * (own - of_all)
    return FanOffsets(
        speeds_rad_s=tuple(centres_rad_s[seen].tolist()),
        offset_sigmas=tuple(tuple(row) for row in np.round(drawn[:, seen], DIGITS).tolist()),
    )


def _by_fan(values: Array, numbers: Array) -> Array:
    """(fans, bins) sums over the runs of each fan."""
    sums = np.zeros((numbers.max() + 1, values.shape[1]))
    np.add.at(sums, numbers, values)
    return sums


def _mean(weight: Array, values: Array) -> Array:
    """(rows, 1) over bins."""
    return ((weight * values).sum(axis=1) / np.maximum(weight.sum(axis=1), LEAST))[:, np.newaxis]
