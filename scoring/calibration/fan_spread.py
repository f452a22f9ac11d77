"""How much more or less the residual of each fan varies than that of all fans.

A twin errs in the same units for all fans, but its sigma is that of a fan and of its tacho. A tacho that counts over
1 s resolves twice as well as one that counts over 0.5 s: the same error of the twin is twice as many sigma, and a limit
that is common to both would be too low for one of them.

Each fan has the mean square of its residual relative to that of all fans. Fans that do not differ, or of which too
little was seen, keep a factor of 1: the logarithms are shrunk by their variance between fans and by that of their
estimate (empirical Bayes, see scoring.baseline.fan_offsets).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from schemas.messages import Array
from scoring.baseline.healthy_residual import FanSpread

INDEPENDENT_S = 60.0
"""so far apart, errors of a twin are taken to be independent: they are of the command, which is held for a while"""
DIGITS = 4
TINY = 1e-9


@dataclass(frozen=True, eq=False)
class FanSquares:
    """Sums of one run. known_as: the numbers of its fans. seconds: (fans,) that were scored. residual, persistent:
    (fans,) sums over them of the squares of the standardised residual, and of the low-passed one.
    """

    known_as: range
    seconds: Array
    residual: Array
    persistent: Array


def fan_spread(runs: Sequence[FanSquares]) -> FanSpread | None:
    """The factors of all fans; None where fewer than two were seen."""
    if not runs:
        return None
    fans = max(run.known_as.stop for run in runs)
    seconds, residual, persistent = (np.zeros(fans) for _ in range(3))
    for run in runs:
        seconds[run.known_as] += run.seconds
        residual[run.known_as] += run.residual
        persistent[run.known_as] += run.persistent
    if np.count_nonzero(seconds) < 2:
        return None
    of_residual, of_persistent = _factors(seconds, residual), _factors(seconds, persistent)
    return FanSpread(
        residual=tuple(np.round(of_residual, DIGITS).tolist()),
        persistent=tuple(np.round(of_persistent / of_residual, DIGITS).tolist()),
    )


def _factors(seconds: Array, squares: Array) -> Array:
    """(fans,) standard deviation of each fan over that of all, shrunk; 1 for fans that were not seen."""
    seen = (seconds > 0.0) & (squares > 0.0)
    if np.count_nonzero(seen) < 2:
        return np.ones(len(seconds))
    level = 0.5 * np.log(np.maximum(squares, TINY) / np.maximum(seconds, TINY))
    by_chance = 0.5 * INDEPENDENT_S / np.maximum(seconds, TINY)  # variance of the logarithm of a standard deviation
    weight = np.where(seen, np.minimum(seconds, seconds[seen].mean()), 0.0)
    middle = (weight * level).sum() / weight.sum()
    between = float(np.var(level[seen], ddof=1) - by_chance[seen].mean())
    shrinkage = max(between, 0.0) / (max(between, 0.0) + by_chance) if between > 0.0 else np.zeros(len(seconds))
    return np.where(seen, np.exp(shrinkage * (level - middle)), 1.0)
