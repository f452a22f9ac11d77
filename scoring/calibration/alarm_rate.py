"""Confidence interval of a rate of alarms that were counted in blocks of running: runs, fans, or stretches of time.

Alarms cluster in blocks: a day, or a fan, has many or none. The variance of the count over bootstrapped blocks shows
how many independent alarms it is equivalent to (quasi-Poisson: Wedderburn, Biometrika 61 (1974) 439; block bootstrap:
Kuensch, Annals of Statistics 17 (1989) 1217). The interval is that of Garwood (Biometrika 28 (1936) 437) for this
number.
"""

from __future__ import annotations

import numpy as np
from scipy.special import gammaincinv

from schemas.messages import Array

BOOTSTRAPS = 1000
COVERAGE = 0.95


def rate_interval(counts: Array, exposures: Array, seed: int) -> tuple[float, float]:
    """95 % interval of the rate per unit of exposure. counts, exposures: (blocks,)."""
    total = float(exposures.sum())
    independent = 1.0 / dispersion(counts, exposures, seed)
    low, high = poisson_interval(float(counts.sum()) * independent)
    return low / independent / total, high / independent / total


def poisson_interval(count: float) -> tuple[float, float]:
    """95 % interval of the expected count, given the count."""
    outside = (1.0 - COVERAGE) / 2
    low = float(gammaincinv(count, outside)) if count > 0 else 0.0
    return low, float(gammaincinv(count + 1, 1.0 - outside))


def dispersion(counts: Array, exposures: Array, seed: int) -> float:
    """Variance of the count over bootstrapped blocks, relative to that of independent alarms; at least one."""
    if not counts.sum():
        return 1.0
    random = np.random.default_rng(seed)
    drawn = random.integers(0, len(counts), (BOOTSTRAPS, len(counts)))
    rates = counts[drawn].sum(axis=1) / exposures[drawn].sum(axis=1)
    return max(1.0, float(rates.var() * exposures.sum() ** 2 / counts.sum()))
