"""How well each single fault explains a window, as a marginal likelihood.

A hypothesis is one term of the balance (scoring.diagnosis.regression_window), one size u and one time course. Its
residual is r - u d; the noise of a row is normal with standard deviation sigma. Rows are means of samples that are
correlated in time, and so are rows: both follow from the autocorrelation time (a first-order autoregression), and n
rows count as n_eff = n / inflation. With a normal prior of standard deviation s on u, truncated to the sizes that the
cause can have, the integral over u has the closed form

    Z = sigma^-n_eff exp(-(S - m^2 A v) / (2 v)) / sqrt(A s^2) * P(u allowed | posterior) / P(u allowed | prior)
    v = sigma^2 inflation    A = d.d / v + 1 / s^2    m = d.r / (A v)    S = r.r

The factor 1 / sqrt(A s^2) penalises a free size, Occam's factor (MacKay, Information Theory, Inference, and Learning
Algorithms, 2003, chapter 28). Two hypotheses that the motion does not distinguish get the same Z, without a special
rule.

sigma is summed over, from the healthy one upwards: a hypothesis that fits badly needs a larger sigma, which widens all
its uncertainties. Errors of the healthy coefficients, and a slow torque where one is possible, are normal unknowns with
zero mean. They are integrated out first, which changes the products of the columns and not the formulas.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import log_ndtr

from scoring.diagnosis.regression_window import (
    COMMAND,
    CONSTANT,
    DRAG,
    FIRST_ERROR,
    JUMP,
    RESIDUAL,
    SQUARE,
    Array,
    HealthyBalance,
    RegressionWindow,
    mean_of_correlated,
)

INFINITE = float("inf")
MIN_SCALE = 1e-9
SIGMAS = np.array([0.7, 0.85, 1.0, 1.2, 1.5, 2.0, 3.0, 4.5, 7.0, 10.0, 15.0])
"""in multiples of the healthy one; the farther from 1, the less probable"""
LOG_SIGMA_PRIOR: Array = -2.0 * np.abs(np.log(SIGMAS))
LOG_SIGMA_PRIOR -= np.log(np.exp(LOG_SIGMA_PRIOR).sum())

LATER_S = np.array([0.01, 0.02, 0.03, 0.05, 0.08, 0.12, 0.17, 0.23, 0.3, 0.4, 0.5, 0.65, 0.8, 1.0, 1.25, 1.5, 2.0])
STEP_CHANGE_S = np.concatenate((-LATER_S[::-1], [0.0], LATER_S))
"""possible times of a step change, in seconds after the onset that the detector found"""
RAMP_S = -np.array([60.0, 30.0, 20.0, 14.0, 10.0, 7.0, 5.0, 3.5, 2.5, 1.6, 1.0, 0.5, 0.0])
"""possible starts of a linear growth"""
VARYING_S = 1.0
VARYING = np.array([0.03, 0.1, 0.3])
"""a torque that comes and goes: a new value each second, with these standard deviations in typical commands"""


@dataclass(frozen=True)
class FaultHypothesis:
    """One fault, as a term in the balance.

    terms: what a size of one adds to the torque, by column. lowest, largest: possible sizes. size_std: prior standard
    deviation of the size, in typical commands where `absolute`. abrupt: prior probability of a step change; otherwise
    the fault has grown or was present throughout. curved: the effect is not proportional to the size. varies: prior
    probability that the fault comes and goes. weight: prior probability relative to the other faults.
    """

    name: str
    parameter: str
    terms: dict[int, float]
    lowest: float
    largest: float
    size_std: float
    abrupt: float
    absolute: bool = False
    curved: bool = False
    varies: float = 0.0
    weight: float = 1.0


# Sizes: the typical effect of each is a fifth of the typical command, so that no prior favours one.
# Time courses: an object touches a rotor at one moment. Friction of a bearing grows over hours, so that within a window
# it is constant or grows; a jump is rare. An inlet may be covered at once or clog slowly.
# A tacho counts pulses: a change of its scale is rare and shows as a jump of its readings.
CAUSES = (
    FaultHypothesis("drag_up", "drag", {DRAG: 1.0}, 0.0, INFINITE, 0.6, abrupt=0.5),
    FaultHypothesis("drag_down", "drag", {DRAG: 1.0}, -1.0, 0.0, 0.4, abrupt=0.7),
    FaultHypothesis("friction_up", "friction", {CONSTANT: 1.0}, 0.0, INFINITE, 0.2, abrupt=0.1, absolute=True),
    FaultHypothesis("gain_down", "gain", {COMMAND: -1.0}, -1.0, 0.0, 0.25, abrupt=0.5),
    FaultHypothesis(
        "external_torque", "torque", {CONSTANT: 1.0}, -INFINITE, INFINITE, 0.2, abrupt=1.0, absolute=True, varies=0.3
    ),
    FaultHypothesis(
        "sensor_scaling",
        "speed reading",
        {COMMAND: -1.0, JUMP: -1.0},
        -0.9,
        INFINITE,
        0.25,
        abrupt=0.7,
        curved=True,
        weight=0.05,
    ),
)


@dataclass(frozen=True)
class Explanation:
    """The log evidence of a cause, and the mean and 95 % interval of its size."""

    cause: FaultHypothesis
    log_evidence: float
    size: float
    low: float
    high: float


class Comparison:
    """Compares all causes over one window."""

    def __init__(self, window: RegressionWindow, healthy: HealthyBalance) -> None:
        variance, inflation = mean_of_correlated(healthy.autocorrelation_time_s / window.period_s, window.per_row)
        self._sigma = max(healthy.sigma_command, MIN_SCALE) * np.sqrt(variance) * SIGMAS
        self._typical_command = max(window.typical_command, healthy.sigma_command, MIN_SCALE)
        self._variance = self._sigma**2 * inflation
        self._effective = window.rows / inflation
        self._constant_need = window.constant_need
        first_s, last_s = -window.onset * window.period_s, (window.samples - 1 - window.onset) * window.period_s
        steps_s = STEP_CHANGE_S[(first_s < STEP_CHANGE_S) & (last_s > STEP_CHANGE_S)]
        begin_s = np.concatenate((steps_s, RAMP_S, [-np.inf]))
        is_step = np.arange(len(begin_s)) < len(steps_s)
        self._log_course = {
            True: np.where(is_step, -np.log(len(steps_s)), -np.inf),
            False: np.where(is_step, -np.inf, -np.log(len(RAMP_S) + 1)),
        }
        grows = (begin_s < last_s) & ~is_step & np.isfinite(begin_s)
        columns = window.columns(begin_s, np.where(grows, last_s, begin_s))
        self._products = columns @ columns.swapaxes(-1, -2)
        edges_s = np.append(np.arange(0.0, max(last_s, 1e-9), VARYING_S), np.inf)
        from_edges = window.columns(edges_s, edges_s)[:, CONSTANT]
        whole = np.vstack((columns[np.searchsorted(steps_s, 0.0)], from_edges[:-1] - from_edges[1:]))
        self._varying_products = whole @ whole.T

    def nothing(self) -> float:
        """Log evidence that no coefficient changed."""
        product, log_det = self._without_errors(self._products[-1:])
        return log_sum(self._log_likelihood(product[..., RESIDUAL, RESIDUAL], log_det) + LOG_SIGMA_PRIOR)

    def explain(self, cause: FaultHypothesis) -> Explanation:
        """The log evidence of a cause, and its size."""
        size_std = cause.size_std * (self._typical_command if cause.absolute else 1.0)
        log_course = np.logaddexp(
            np.log(cause.abrupt) + self._log_course[True],
            np.log1p(-cause.abrupt) + self._log_course[False] if cause.abrupt < 1.0 else -np.inf,
        )
        used = np.isfinite(log_course)
        parts = [self._evidence(cause, size_std, self._products[used])]
        weights = [np.log1p(-cause.varies) + log_course[used]]
        if cause.varies:
            for deviation in VARYING * self._typical_command:
                scale = np.ones(len(self._varying_products))
                scale[FIRST_ERROR + 4 :] = deviation
                parts.append(self._evidence(cause, size_std, (self._varying_products * np.outer(scale, scale))[None]))
                weights.append(np.array([np.log(cause.varies / len(VARYING))]))
        log_evidence = np.concatenate([p[0] + w[:, None] for p, w in zip(parts, weights, strict=True)])
        log_evidence += LOG_SIGMA_PRIOR + np.log(cause.weight)
        mean, deviation = (np.concatenate([part[i] for part in parts]) for i in (1, 2))
        total = log_sum(log_evidence)
        share = np.exp(log_evidence - total)
        size = float((share * mean).sum())
        half_interval = 1.96 * float(np.sqrt((share * (deviation**2 + (mean - size) ** 2)).sum()))
        low, high = np.clip((size - half_interval, size + half_interval), cause.lowest, cause.largest)
        return Explanation(cause, total, size, float(low), float(high))

    def _evidence(self, cause: FaultHypothesis, size_std: float, products: Array) -> tuple[Array, Array, Array]:
        """Log evidence, mean and standard deviation of the size, (courses, sigmas) each."""
        product, log_det = self._without_errors(products)
        residual = np.zeros((*product.shape[:2], FIRST_ERROR))
        residual[..., RESIDUAL] = 1.0
        direction = np.zeros_like(residual)
        for column, weight in cause.terms.items():
            direction[..., column] = weight
        r, d = residual, direction
        rounds = 6 if cause.curved else 1
        mean = precision = s = np.zeros(product.shape[:2])
        for _ in range(rounds):
            if cause.curved:
                # The quadratic torque falls by 1 - 1 / (1 + u), linearised at the size found so far.
                slope = 1.0 / (1.0 + mean) ** 2
                r, d = residual.copy(), direction.copy()
                r[..., SQUARE] = 1.0 - 1.0 / (1.0 + mean) - mean * slope
                d[..., SQUARE] = -slope
                d[..., CONSTANT] = self._constant_need
            rp = (product @ r[..., None])[..., 0]
            s, b = (r * rp).sum(-1), (d * rp).sum(-1)
            c = (d * (product @ d[..., None])[..., 0]).sum(-1)
            precision = c / self._variance + 1.0 / size_std**2
            mean = np.clip(b / self._variance / precision, cause.lowest if cause.curved else -np.inf, None)
        quadratic = s - mean**2 * precision * self._variance
        log_z = self._log_likelihood(quadratic, log_det) - 0.5 * np.log(precision * size_std**2)
        width = 1.0 / np.sqrt(precision)
        log_z += _log_mass(cause, mean, width) - _log_mass(cause, np.zeros(1), np.full(1, size_std))
        return log_z, *_truncated(cause, mean, width)

    def _without_errors(self, products: Array) -> tuple[Array, Array]:
        """Products with the errors integrated out, (courses, sigmas, 6, 6), and log determinants, (courses, sigmas)."""
        q = FIRST_ERROR
        kept, mixed, errors = products[:, :q, :q], products[:, :q, q:], products[:, q:, q:]
        values, vectors = np.linalg.eigh(errors)
        values = np.maximum(values, 0.0)[:, np.newaxis, :]
        rotated = (mixed @ vectors)[:, np.newaxis]
        variance = self._variance[:, np.newaxis]
        reduced = kept[:, np.newaxis] - (rotated / (variance + values)[..., np.newaxis, :]) @ rotated.swapaxes(-1, -2)
        return reduced, np.log1p(values / variance).sum(-1)

    def _log_likelihood(self, quadratic: Array, log_det: Array) -> Array:
        return -self._effective * np.log(self._sigma) - 0.5 * (quadratic / self._variance + log_det)


def log_sum(logs: Array) -> float:
    """Log of the sum of numbers given by their logs."""
    largest = logs.max()
    return float(largest + np.log(np.exp(logs - largest).sum()))


def _log_mass(cause: FaultHypothesis, mean: Array, width: Array) -> Array:
    """Log of the probability that a normally distributed size is one that the cause can have."""
    low, high = (cause.lowest - mean) / width, (cause.largest - mean) / width
    # Computed from the side of the smaller tail, to avoid cancellation.
    mirrored = low > -high
    low, high = np.where(mirrored, -high, low), np.where(mirrored, -low, high)
    below, above = log_ndtr(low), log_ndtr(high)
    return above + np.log1p(-np.exp(np.minimum(below - above, -1e-12)))


def _truncated(cause: FaultHypothesis, mean: Array, width: Array) -> tuple[Array, Array]:
    """Mean and standard deviation of a normal distribution truncated to the sizes that the cause can have."""
    low, high = (cause.lowest - mean) / width, (cause.largest - mean) / width
    log_mass = _log_mass(cause, mean, width)
    at_low, at_high = (np.exp(-0.5 * z**2 - 0.5 * np.log(2.0 * np.pi) - log_mass) for z in (low, high))
    shift = at_low - at_high
    edge = np.where(np.isfinite(low), low, 0.0) * at_low - np.where(np.isfinite(high), high, 0.0) * at_high
    cut = np.clip(mean + width * shift, cause.lowest, cause.largest)
    return cut, width * np.sqrt(np.clip(1.0 + edge - shift**2, 0.0, 1.0))
