"""The measured speed minus the free run: whether it is noise, or dynamics that the model lacks.

The residual of a perfect model is white and independent of the command. Per fan: its autocorrelation with a whiteness
test, and its cross-correlation with the command. Definitions and bounds: Ljung, System Identification, 2nd ed., section
16.6; Soderstrom and Stoica, System Identification, sections 11.2 and C.1. Whiteness: Ljung and Box, Biometrika 65
(1978) 297; with missing samples as Stoffer and Toloi, Statistics & Probability Letters 13 (1992) 391.

The first seconds of each run are left out: a free run starts from a measured speed, and forgets its error only within
some time constants of the fan. Samples are laid on a grid of the runs' median step: a longer step leaves slots empty,
jitter within a step is not seen. Runs are separated by more than the longest lag, so that no product combines the end
of one with the start of another.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.fft import next_fast_len
from scipy.special import chdtrc

from twin.errors import TwinError
from twin.evaluation.accuracy import healthy_sigma_rad_s
from twin.runs import Array, Run

SETTLING_S = 3.0
SHARE_SETTLING = 0.5
MAX_LAG_S = 5.0
MAX_LAGS = 1000
WINDOW_S = 10.0
LONGEST_LAG_OF_RUN = 0.25
LJUNG_BOX_LAGS = 20
MIN_SAMPLES = 20
NORMAL_95 = 1.96
SIGNIFICANCE = 0.05
QUANTILES = (0.95, 0.99, 0.999)


@dataclass(frozen=True, eq=False)
class ResidualAnalysis:
    """One fan's free-run residual. NaN where undefined: too few samples, a diverged run, a constant command.

    samples: the measured ones. period_s: of the grid. mean_rad_s: mean of measured minus free run. independent_samples:
    the number of independent samples whose mean is equally certain; at most samples. autocorrelation_time_s: half the
    time from one independent sample to the next; T where it decays as exp(-t / T). lags_s, autocorrelation: (lags,)
    from one step on, about the mean. bound_95: white noise stays within it at 95 % of the lags. ljung_box_p:
    probability of so much autocorrelation over the first ljung_box_lags in white noise. cross_lags_s,
    cross_correlation: (2 lags + 1,) of residual(t) with command(t - lag). A positive lag is causal: the residual
    follows the command, and is positive where the fan responds more than the model. A negative one is feedback: the
    command answers the residual. cross_bound_95: two signals that are each correlated in themselves as these are, and
    unrelated, stay within it at 95 % of the lags.
    """

    samples: int
    period_s: float
    mean_rad_s: float
    independent_samples: float
    autocorrelation_time_s: float
    lags_s: Array
    autocorrelation: Array
    bound_95: float
    ljung_box_lags: int
    ljung_box_p: float
    cross_lags_s: Array
    cross_correlation: Array
    cross_bound_95: float

    @property
    def white(self) -> bool | None:
        """Whether the Ljung-Box test finds nothing at the 5 % level; None where it had nothing to test."""
        return None if np.isnan(self.ljung_box_p) else self.ljung_box_p >= SIGNIFICANCE

    @property
    def cross_peak_lag_s(self) -> float:
        """The causal lag, from zero on, at which the residual follows the command most; NaN where undefined."""
        return float(self.cross_lags_s[self._causal_peak()]) if np.isfinite(self.cross_bound_95) else np.nan

    @property
    def cross_over_bound(self) -> float:
        """The largest causal cross-correlation in bounds, with its sign. Values up to 2 occur by chance, because there
        are many lags."""
        return float(self.cross_correlation[self._causal_peak()] / self.cross_bound_95)

    def _causal_peak(self) -> int:
        causal = len(self.cross_lags_s) // 2
        return causal + int(np.argmax(np.nan_to_num(np.abs(self.cross_correlation[causal:]))))


@dataclass(frozen=True)
class HealthyResidual:
    """The healthy free-run residual for a model card; each tuple has one entry a fan.

    sigma_rad_s: root mean square. autocorrelation_time_s, independent_samples: as in ResidualAnalysis.
    quantiles_sigma: |residual| / sigma at the probabilities QUANTILES (normal: 1.96, 2.58, 3.29); max_sigma: at most.
    """

    sigma_rad_s: tuple[float, ...]
    autocorrelation_time_s: tuple[float, ...]
    independent_samples: tuple[float, ...]
    quantiles_sigma: tuple[tuple[float, ...], ...]
    max_sigma: tuple[float, ...]


@dataclass(frozen=True, eq=False)
class _Grid:
    """Where samples lie: slot of each (samples,), number of slots, step, longest lag shown and window, in slots."""

    slot: NDArray[np.intp]
    slots: int
    period_s: float
    lags: int
    window: int


def analyse_residual(
    residual_rad_s: Array, pieces: Sequence[Run], *, settling_s: float = SETTLING_S, max_lag_s: float = MAX_LAG_S
) -> tuple[ResidualAnalysis, ...]:
    """The analysis of each fan. residual_rad_s: (samples, fans) as free_run_residuals gives it for these pieces.

    settling_s: left out at the start of each piece, but at most half of it. Lags go to max_lag_s, but not beyond a
    quarter of the longest piece or 1000 steps. Raises TwinError when residual and pieces are not of one length.
    """
    settled = _settled(residual_rad_s, pieces, settling_s)
    grid = _lay_out(pieces, max_lag_s)
    command = np.concatenate([piece.command for piece in pieces])
    return tuple(_of_fan(settled[:, fan], command[:, fan], grid) for fan in range(settled.shape[1]))


def healthy_residual(
    residual_rad_s: Array, pieces: Sequence[Run], *, settling_s: float = SETTLING_S
) -> HealthyResidual:
    """The healthy residual for a card. Arguments and errors as of analyse_residual."""
    settled = _settled(residual_rad_s, pieces, settling_s)
    sigma_rad_s = healthy_sigma_rad_s(settled)
    analyses = analyse_residual(residual_rad_s, pieces, settling_s=settling_s)
    with np.errstate(invalid="ignore", divide="ignore"):
        in_sigma = np.abs(settled) / sigma_rad_s
    quantiles = [_quantiles(fan[np.isfinite(fan)]) for fan in in_sigma.T]
    return HealthyResidual(
        sigma_rad_s=tuple(sigma_rad_s.tolist()),
        autocorrelation_time_s=tuple(fan.autocorrelation_time_s for fan in analyses),
        independent_samples=tuple(fan.independent_samples for fan in analyses),
        quantiles_sigma=tuple(tuple(fan[:-1].tolist()) for fan in quantiles),
        max_sigma=tuple(float(fan[-1]) for fan in quantiles),
    )


def _quantiles(in_sigma: Array) -> Array:
    """At QUANTILES and, last, the largest; NaN where there are none."""
    return np.quantile(in_sigma, (*QUANTILES, 1.0)) if in_sigma.size else np.full(len(QUANTILES) + 1, np.nan)


def _settled(residual: Array, pieces: Sequence[Run], settling_s: float) -> Array:
    """The residual without the first part of each run, which depends on its start. A divergence is never left out."""
    samples = sum(piece.samples for piece in pieces)
    if len(residual) != samples or samples == 0:
        raise TwinError(f"a residual of {len(residual)} samples, runs of {samples}; give the runs that it was made of")
    age_s = [piece.t_s - piece.t_s[0] for piece in pieces]
    young = np.concatenate([age < min(settling_s, SHARE_SETTLING * age[-1]) for age in age_s])
    return np.where(young[:, np.newaxis] & np.isfinite(residual), np.nan, residual)


def _lay_out(pieces: Sequence[Run], max_lag_s: float) -> _Grid:
    period_s = float(np.median(np.concatenate([np.diff(piece.t_s) for piece in pieces])))
    within = [
        np.concatenate(([0], np.cumsum(np.maximum(np.rint(np.diff(piece.t_s) / period_s), 1.0)))).astype(int)
        for piece in pieces
    ]
    longest = int(LONGEST_LAG_OF_RUN * max(slots[-1] + 1 for slots in within))
    lags = max(1, min(round(max_lag_s / period_s), longest, MAX_LAGS))
    window = max(lags, min(round(WINDOW_S / period_s), longest))
    start = np.cumsum([0, *(slots[-1] + 1 + window for slots in within)])
    slot = np.concatenate([first + slots for first, slots in zip(start[:-1], within, strict=True)])
    return _Grid(slot, int(start[-1]), period_s, lags, window)


def _of_fan(residual: Array, command: Array, grid: _Grid) -> ResidualAnalysis:
    measured = np.isfinite(residual)
    samples = int(np.count_nonzero(measured))
    lags_s = grid.period_s * np.arange(1, grid.lags + 1, dtype=np.float64)
    cross_lags_s = grid.period_s * np.arange(-grid.lags, grid.lags + 1, dtype=np.float64)
    if samples < MIN_SAMPLES or np.any(np.isinf(residual)) or np.ptp(residual[measured]) == 0.0:
        nothing = np.full_like(lags_s, np.nan)
        nothing_cross = np.full_like(cross_lags_s, np.nan)
        return ResidualAnalysis(
            samples, grid.period_s, np.nan, np.nan, np.nan, lags_s, nothing, np.nan, 0, np.nan,
            cross_lags_s, nothing_cross, np.nan,
        )  # fmt: skip
    mean = float(residual[measured].mean())
    error, known = _on_grid(np.where(measured, residual - mean, 0.0), grid), _on_grid(measured, grid)
    products, pairs = _lagged_sums(error, error, grid.window), np.rint(_lagged_sums(known, known, grid.window))
    products, pairs = products[grid.window :], pairs[grid.window :]
    autocorrelation = _ratio(products, pairs) / (products[0] / samples)
    inflation, time_in_steps = _integrated(autocorrelation, pairs / samples)
    tested = pairs[1 : min(LJUNG_BOX_LAGS, grid.lags) + 1]
    seen = tested > 0.0
    squares = tested[seen] * autocorrelation[1 : len(tested) + 1][seen] ** 2
    portmanteau = (samples + 2.0) / samples * squares.sum()
    cross_correlation, cross_bound = _cross(error, known, products, command, grid)
    return ResidualAnalysis(
        samples=samples,
        period_s=grid.period_s,
        mean_rad_s=mean,
        independent_samples=samples / inflation,
        autocorrelation_time_s=grid.period_s * time_in_steps,
        lags_s=lags_s,
        autocorrelation=autocorrelation[1 : grid.lags + 1],
        bound_95=float(NORMAL_95 / np.sqrt(_typical(pairs[1 : grid.lags + 1]))),
        ljung_box_lags=int(np.count_nonzero(seen)),
        ljung_box_p=float(chdtrc(np.count_nonzero(seen), portmanteau)) if seen.any() else np.nan,
        cross_lags_s=cross_lags_s,
        cross_correlation=cross_correlation,
        cross_bound_95=cross_bound,
    )


def _integrated(autocorrelation: Array, weight: Array) -> tuple[float, float]:
    """Factor by which correlation inflates the variance of the mean, and the autocorrelation time in steps.

    The sums end where two neighbouring lags together are no longer positive: what follows is noise (the initial
    positive sequence of Geyer, Statistical Science 7 (1992) 473). weight: share of pairs that each lag has. Lags that
    no pair has take the value between their neighbours.
    """
    lag = np.arange(len(autocorrelation))
    has = np.isfinite(autocorrelation)
    filled = np.interp(lag, lag[has], autocorrelation[has])
    even = filled[: len(filled) // 2 * 2]
    negative = even.reshape(-1, 2).sum(axis=1) <= 0.0
    end = 2 * int(np.argmax(negative)) if negative.any() else len(even)
    inflation = 1.0 + 2.0 * float(np.sum(filled[1:end] * weight[1:end]))
    return max(inflation, 1.0), max(0.5 + float(np.sum(filled[1:end])), 0.5)


def _cross(error: Array, known: Array, products: Array, command: Array, grid: _Grid) -> tuple[Array, float]:
    """Cross-correlation at the lags shown, and its 95 % bound.

    The variance of the mean product of two unrelated signals is sum_k R_ee(k) R_uu(k) / N. The sum is tapered by a
    Parzen window: an autocorrelation at long lags is noise, and the taper keeps the sum positive.
    """
    if np.ptp(command) == 0.0:
        return np.full(2 * grid.lags + 1, np.nan), np.nan
    driven = _on_grid(np.ones(len(command)), grid)
    drive = _on_grid(command - command.mean(), grid)
    scale = np.sqrt(products[0] / known.sum()) * command.std()
    pairs = np.rint(_lagged_sums(known, driven, grid.lags))
    cross_correlation = _ratio(_lagged_sums(error, drive, grid.lags), pairs) / scale
    drive_products = _lagged_sums(drive, drive, grid.window)[grid.window :] / len(command)
    terms = _parzen(grid.window) * products * drive_products
    deviation = np.sqrt(terms[0] + 2.0 * terms[1:].sum()) / _typical(pairs)
    return cross_correlation, float(NORMAL_95 * deviation / scale)


def _on_grid(values: Array, grid: _Grid) -> Array:
    """(slots,) values (samples,) in their slots, zero elsewhere."""
    laid = np.zeros(grid.slots)
    laid[grid.slot] = values
    return laid


def _lagged_sums(left: Array, right: Array, lags: int) -> Array:
    """(2 lags + 1,) sum over t of left(t) right(t - lag), lag from -lags to lags."""
    size = next_fast_len(len(left) + lags, real=True)
    circular = np.fft.irfft(np.fft.rfft(left, size) * np.conj(np.fft.rfft(right, size)), size)
    return np.concatenate((circular[-lags:], circular[: lags + 1]))


def _parzen(window: int) -> Array:
    """(window + 1,) Parzen's lag window, from one at lag zero to none at the last."""
    x = np.arange(window + 1) / window
    return np.where(x <= 0.5, 1.0 - 6.0 * x**2 * (1.0 - x), 2.0 * (1.0 - x) ** 3)


def _ratio(sums: Array, pairs: Array) -> Array:
    return np.divide(sums, pairs, out=np.full_like(sums, np.nan), where=pairs > 0.0)


def _typical(pairs: Array) -> float:
    """The median number of pairs among lags that have any; NaN where none has."""
    having = pairs[pairs > 0.0]
    return float(np.median(having)) if having.size else np.nan
