"""The measured speed minus the free run: whether it is noise, or dynamics that the model lacks.

The residual of a perfect model is white and independent of the command. Per fan: its autocorrelation with a whiteness
test, and its cross-correlation with the command. Definitions and bounds: Ljung, System Identification, 2nd ed., section
16.6; Soderstrom and Stoica, System Identification, sections 11.2 and C.1. Whiteness: Ljung and Box, Biometrika 65
(1978) 297; with missing samples as Stoffer and Toloi, Statistics & Probability Letters 13 (1992) 391.

The first seconds of each run are left out: a free run starts from a measured speed, and forgets its error only within
some time constants of the fan. Samples are laid on a grid of the runs' median step: a longer step leaves slots empty,
jitter within a step is not seen. All that the analysis needs are sums over pairs of samples of one run, so runs can be
summed one by one (ResidualSums), wherever they are.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import reduce
from operator import add

import numpy as np
from numpy.typing import NDArray
from scipy.fft import next_fast_len
from scipy.special import chdtrc

from fantwin.schemas.twin_card import HealthyCard
from fantwin.twin.evaluation.accuracy import sums_by_fan
from fantwin.twin.runs import Array, Run

Spectrum = NDArray[np.complex128]

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


@dataclass(frozen=True, eq=False, kw_only=True)
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
    mean_rad_s: float = np.nan
    independent_samples: float = np.nan
    autocorrelation_time_s: float = np.nan
    lags_s: Array
    autocorrelation: Array
    bound_95: float = np.nan
    ljung_box_lags: int = 0
    ljung_box_p: float = np.nan
    cross_lags_s: Array
    cross_correlation: Array
    cross_bound_95: float = np.nan

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
class ResidualGrid:
    """The grid that samples are laid on: its step, and in steps the longest lag shown and the window of the sums."""

    period_s: float
    lags: int
    window: int


def residual_grid(period_s: float, longest_s: float) -> ResidualGrid:
    """The grid for runs with a median step of period_s, whose longest stretch without a gap lasts longest_s.

    Lags go to MAX_LAG_S, but not beyond a quarter of longest_s or MAX_LAGS steps.
    """
    longest = int(LONGEST_LAG_OF_RUN * (max(round(longest_s / period_s), 1) + 1))
    lags = max(1, min(round(MAX_LAG_S / period_s), longest, MAX_LAGS))
    return ResidualGrid(period_s, lags, max(lags, min(round(WINDOW_S / period_s), longest)))


@dataclass(frozen=True, eq=False)
class ResidualSums:
    """Sums over runs, for each fan, from which its residual is analysed. They can be added.

    e is the residual where it is measured, known is one there; u is the command, driven is one at every sample; all are
    zero elsewhere on the grid. count, error: (fans,) sums of known and e. commands, command: the same of driven and u.
    auto: (3, fans, window + 1) sums of products at each lag: e e, e known + known e, known known. drive: the same of u
    and driven. cross: (4, fans, 2 lags + 1) of e u, e driven, known u, known driven, the second factor a lag earlier.
    lowest, highest: (2, fans) of e and u; infinite e where a free run diverged.
    """

    count: Array
    error: Array
    commands: Array
    command: Array
    auto: Array
    drive: Array
    cross: Array
    lowest: Array
    highest: Array

    def __add__(self, other: "ResidualSums") -> "ResidualSums":
        sums = {name: value + getattr(other, name) for name, value in vars(self).items()}
        sums["lowest"], sums["highest"] = np.minimum(self.lowest, other.lowest), np.maximum(self.highest, other.highest)
        return ResidualSums(**sums)


def residual_sums(
    residual_rad_s: Array, pieces: Sequence[Run], grid: ResidualGrid, settling_s: float = SETTLING_S
) -> ResidualSums:
    """The sums over pieces. residual_rad_s: (samples, fans) as free_run_residuals gives it for them.

    settling_s: time left out at the start of each piece, at most half of the piece.
    """
    settled = _settled(residual_rad_s, pieces, settling_s)
    ends = np.cumsum([piece.samples for piece in pieces])
    parts = np.split(settled, ends[:-1])
    return reduce(add, (_sums_of_piece(part, piece, grid) for part, piece in zip(parts, pieces, strict=True)))


def _sums_of_piece(settled: Array, piece: Run, grid: ResidualGrid) -> ResidualSums:
    steps = np.maximum(np.rint(np.diff(piece.t_s) / grid.period_s), 1.0)
    slots = np.concatenate(([0], np.cumsum(steps))).astype(int)
    size = next_fast_len(int(slots[-1]) + 1 + grid.window, real=True)
    within, around = np.arange(grid.window + 1), np.arange(-grid.lags, grid.lags + 1)

    def transform(values: Array) -> Spectrum:
        laid = np.zeros(int(slots[-1]) + 1)
        laid[slots] = values
        return np.fft.rfft(laid, size)

    def lagged(left: Spectrum, right: Spectrum) -> Array:
        """(size,) sums over t of left(t) right(t - lag), of negative lags at the end."""
        return np.fft.irfft(left * np.conj(right), size)

    def auto(signal: Spectrum, there: Spectrum) -> Array:
        with_there = lagged(signal, there)
        return np.stack(
            (lagged(signal, signal)[within], with_there[within] + with_there[-within], lagged(there, there)[within])
        )

    driven = transform(np.ones(piece.samples))
    measured = np.isfinite(settled)
    autos, drives, crosses = [], [], []
    for fan, is_measured in enumerate(measured.T):
        error, known = transform(np.where(is_measured, settled[:, fan], 0.0)), transform(is_measured)
        command = transform(piece.command[:, fan])
        autos.append(auto(error, known))
        drives.append(auto(command, driven))
        crosses.append(np.stack([lagged(one, of)[around] for one in (error, known) for of in (command, driven)]))
    return ResidualSums(
        count=measured.sum(axis=0, dtype=np.float64),
        error=sums_by_fan(np.where(measured, settled, 0.0)),
        commands=np.full(piece.fans, float(piece.samples)),
        command=sums_by_fan(piece.command),
        auto=np.stack(autos, axis=1),
        drive=np.stack(drives, axis=1),
        cross=np.stack(crosses, axis=1),
        lowest=np.stack((np.where(np.isnan(settled), np.inf, settled).min(axis=0), piece.command.min(axis=0))),
        highest=np.stack((np.where(np.isnan(settled), -np.inf, settled).max(axis=0), piece.command.max(axis=0))),
    )


def analyse_residual(
    residual_rad_s: Array, pieces: Sequence[Run], *, settling_s: float = SETTLING_S
) -> tuple[ResidualAnalysis, ...]:
    """The analysis of each fan. Arguments as of residual_sums."""
    period_s = float(np.median(np.concatenate([np.diff(piece.t_s) for piece in pieces])))
    grid = residual_grid(period_s, max(piece.duration_s for piece in pieces))
    return analysis_of(residual_sums(residual_rad_s, pieces, grid, settling_s), grid)


def analysis_of(sums: ResidualSums, grid: ResidualGrid) -> tuple[ResidualAnalysis, ...]:
    """The analysis of each fan from the sums over its runs, all on one grid."""
    return tuple(_of_fan(sums, fan, grid) for fan in range(len(sums.count)))


def healthy_residual(residual_rad_s: Array, pieces: Sequence[Run]) -> tuple[Array, HealthyCard]:
    """Healthy standard deviation (fans,), rad/s, and the healthy residual for a card. Arguments as of residual_sums."""
    settled = _settled(residual_rad_s, pieces, SETTLING_S)
    count = np.maximum(np.isfinite(settled).sum(axis=0), 1)
    with np.errstate(over="ignore"):  # a root mean square, for the band is centred on the twin
        sigma_rad_s = np.sqrt(np.nansum(settled**2, axis=0) / count)
    analyses = analyse_residual(residual_rad_s, pieces)
    with np.errstate(invalid="ignore", divide="ignore"):
        in_sigma = np.abs(settled) / sigma_rad_s
    quantiles = [tuple(map(finite_or_none, _quantiles(fan[np.isfinite(fan)]).tolist())) for fan in in_sigma.T]
    return sigma_rad_s, HealthyCard(
        autocorrelation_time_s=tuple(finite_or_none(fan.autocorrelation_time_s) for fan in analyses),
        independent_samples=tuple(finite_or_none(fan.independent_samples) for fan in analyses),
        probabilities=QUANTILES,
        quantiles_sigma=tuple(fan[:-1] for fan in quantiles),
        max_sigma=tuple(fan[-1] for fan in quantiles),
    )


def finite_or_none(value: float) -> float | None:
    """The value as a card has it: None where it is undefined."""
    return value if np.isfinite(value) else None


def _quantiles(in_sigma: Array) -> Array:
    """At QUANTILES and, last, the largest; NaN where there are none."""
    return np.quantile(in_sigma, (*QUANTILES, 1.0)) if in_sigma.size else np.full(len(QUANTILES) + 1, np.nan)


def _settled(residual: Array, pieces: Sequence[Run], settling_s: float) -> Array:
    """The residual without the first part of each run, which depends on its start. A divergence is never left out."""
    age_s = [piece.t_s - piece.t_s[0] for piece in pieces]
    young = np.concatenate([age < min(settling_s, SHARE_SETTLING * age[-1]) for age in age_s])
    return np.where(young[:, np.newaxis] & np.isfinite(residual), np.nan, residual)


def _of_fan(sums: ResidualSums, fan: int, grid: ResidualGrid) -> ResidualAnalysis:
    samples = int(sums.count[fan])
    lags_s = grid.period_s * np.arange(1, grid.lags + 1, dtype=np.float64)
    cross_lags_s = grid.period_s * np.arange(-grid.lags, grid.lags + 1, dtype=np.float64)
    undefined = ResidualAnalysis(
        samples=samples,
        period_s=grid.period_s,
        lags_s=lags_s,
        autocorrelation=np.full_like(lags_s, np.nan),
        cross_lags_s=cross_lags_s,
        cross_correlation=np.full_like(cross_lags_s, np.nan),
    )
    lowest, highest = sums.lowest[0, fan], sums.highest[0, fan]
    if samples < MIN_SAMPLES or not np.isfinite(highest) or highest == lowest:
        return undefined
    mean = float(sums.error[fan] / samples)
    products, pairs = _about_mean(sums.auto[:, fan], mean), np.rint(sums.auto[2, fan])
    autocorrelation = _ratio(products, pairs) / (products[0] / samples)
    inflation, time_in_steps = _integrated(autocorrelation, pairs / samples)
    tested = pairs[1 : min(LJUNG_BOX_LAGS, grid.lags) + 1]
    seen = tested > 0.0
    squares = tested[seen] * autocorrelation[1 : len(tested) + 1][seen] ** 2
    portmanteau = (samples + 2.0) / samples * squares.sum()
    cross_correlation, cross_bound = _cross(sums, fan, mean, products, grid)
    return replace(
        undefined,
        mean_rad_s=mean,
        independent_samples=samples / inflation,
        autocorrelation_time_s=grid.period_s * time_in_steps,
        autocorrelation=autocorrelation[1 : grid.lags + 1],
        bound_95=float(NORMAL_95 / np.sqrt(_typical(pairs[1 : grid.lags + 1]))),
        ljung_box_lags=int(np.count_nonzero(seen)),
        ljung_box_p=float(chdtrc(np.count_nonzero(seen), portmanteau)) if seen.any() else np.nan,
        cross_correlation=cross_correlation,
        cross_bound_95=cross_bound,
    )


def _about_mean(sums: Array, mean: float) -> Array:
    """(lags,) sums of products of a signal less its mean, from (3, lags) those of ResidualSums.auto or drive."""
    return sums[0] - mean * sums[1] + mean**2 * sums[2]


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


def _cross(sums: ResidualSums, fan: int, mean: float, products: Array, grid: ResidualGrid) -> tuple[Array, float]:
    """Cross-correlation at the lags shown, and its 95 % bound. products: of the residual less its mean.

    The variance of the mean product of two unrelated signals is sum_k R_ee(k) R_uu(k) / N. The sum is tapered by a
    Parzen window: an autocorrelation at long lags is noise, and the taper keeps the sum positive.
    """
    if sums.lowest[1, fan] == sums.highest[1, fan]:
        return np.full(2 * grid.lags + 1, np.nan), np.nan
    mean_command = float(sums.command[fan] / sums.commands[fan])
    drive_products = _about_mean(sums.drive[:, fan], mean_command) / sums.commands[fan]
    scale = np.sqrt(products[0] / sums.count[fan] * drive_products[0])
    of_both, of_error, of_command, of_neither = sums.cross[:, fan]
    pairs = np.rint(of_neither)
    about_means = of_both - mean_command * of_error - mean * of_command + mean * mean_command * of_neither
    cross_correlation = _ratio(about_means, pairs) / scale
    terms = _parzen(grid.window) * products * drive_products
    deviation = np.sqrt(terms[0] + 2.0 * terms[1:].sum()) / _typical(pairs)
    return cross_correlation, float(NORMAL_95 * deviation / scale)


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
