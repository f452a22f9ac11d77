"""Plain rules, each a few lines: the published band, a windowed Gaussian, a CUSUM, and a filtered torque balance.

They learn from healthy runs only. If a rule is published with a limit, it is shown with that limit and also with the
limit that the common budget of false alarms gives it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from scipy.optimize import root_scalar
from scipy.signal import lfilter

from bench.detection.methods import Method
from bench.detection.residuals import Moving, balance_sigmas, speed_sigmas
from fantwin.schemas.messages import Array, Prediction

PUBLISHED_BAND = 2.0
GAUSSIAN_WINDOW_S = 1.0
CUSUM_REFERENCE = 0.5
FILTER_RATE_PER_S = 3.0
BASELINE_S = 1.0


class Band:
    """The published rule: distance of the speed from the prediction, in sigma."""

    def take(self, block: Prediction) -> Array:
        """See methods.Scores."""
        return np.abs(speed_sigmas(block))


class WindowedGaussian:
    """How unlikely the last second of both residuals is for independent normal samples: the mean of their squares.

    While the free run warms up, its residual counts as an ordinary one.
    """

    def __init__(self, rate_hz: float) -> None:
        self._moving = Moving(round(GAUSSIAN_WINDOW_S * rate_hz))

    def take(self, block: Prediction) -> Array:
        """See methods.Scores."""
        speed = np.nan_to_num(speed_sigmas(block), nan=1.0)
        return self._moving.means(np.square(speed) + np.square(balance_sigmas(block)))


class Cusum:
    """Two-sided CUSUM of the speed residual, sample by sample, as for independent ones (Page, Biometrika 41, 1954)."""

    def __init__(self, fans: int) -> None:
        self._sums = np.zeros((2, fans))

    def take(self, block: Prediction) -> Array:
        """See methods.Scores."""
        z = speed_sigmas(block)
        known = np.isfinite(z)
        gains = np.where(known, np.stack((z, -z)) - CUSUM_REFERENCE, 0.0)
        totals = self._sums[:, np.newaxis] + np.cumsum(gains, axis=1)
        sums = totals - np.minimum(np.minimum.accumulate(totals, axis=1), 0.0)
        self._sums = sums[:, -1]
        return np.where(known, sums.max(axis=0), np.nan)


class FilteredBalance:
    """The reference on measured data: torque balance by least squares, less its mean over the first second.

    coefficients: (4,) of `fitted_balance`, for one fan.
    """

    def __init__(self, coefficients: Array) -> None:
        self._coefficients = coefficients
        self._filtered = _Filtered()
        self._row = 0
        self._baseline = math.nan
        self._first: list[float] = []

    def take(self, block: Prediction) -> Array:
        """See methods.Scores."""
        terms = self._filtered.take(block)
        balance = terms[:, 0] - terms[:, 1:] @ self._coefficients
        seconds = (self._row + np.arange(len(balance))) * block.period_ns / 1e9
        self._row += len(balance)
        if math.isnan(self._baseline):
            self._first += balance[seconds < BASELINE_S].tolist()
            if seconds[-1] >= BASELINE_S:
                self._baseline = float(np.nanmean(self._first))
        return np.where(seconds < BASELINE_S, np.nan, np.abs(balance - self._baseline))[:, np.newaxis]


class _Filtered:
    """Both sides through lambda / (s + lambda): effort, and what each coefficient multiplies: 1, w, w|w|, w'.

    The filter begins empty and is divided by what it has seen, so that its start counts for nothing.
    """

    def __init__(self) -> None:
        self._state = np.zeros((1, 6))
        self._speed_rad_s = math.nan

    def take(self, block: Prediction) -> Array:
        """(n, 5), NaN where the speed is not known."""
        w, effort = block.measured_speed_rad_s[:, 0], block.command[:, 0]
        rise = np.diff(w, prepend=self._speed_rad_s) / (block.period_ns / 1e9)
        self._speed_rad_s = float(w[-1])
        one = np.ones_like(w)
        signals = np.column_stack((effort, one, w, w * np.abs(w), rise, one))
        known = np.asarray(np.isfinite(signals).all(axis=1))
        keep = math.exp(-FILTER_RATE_PER_S * block.period_ns / 1e9)
        weighed = np.where(known[:, np.newaxis], signals, 0.0)
        outcome = lfilter([1.0 - keep], [1.0, -keep], weighed, axis=0, zi=self._state)
        filtered, self._state = np.asarray(outcome[0]), np.asarray(outcome[1])
        seen = np.where(known, filtered[:, 5], np.nan)
        return filtered[:, :5] / seen[:, np.newaxis]


def fitted_balance(runs: Sequence[Sequence[Prediction]]) -> Array:
    """(4,) least squares of the filtered effort on 1, w, w|w| and w', over healthy runs of one fan."""
    parts = []
    for run in runs:
        filtered = _Filtered()
        parts.append(np.concatenate([filtered.take(block) for block in run]))
    terms = np.concatenate(parts)
    terms = terms[np.isfinite(terms).all(axis=1)]
    return np.linalg.lstsq(terms[:, 1:], terms[:, 0], rcond=None)[0]


def textbook_cusum_limit(samples_between: float, reference: float = CUSUM_REFERENCE) -> float:
    """The limit at which a two-sided CUSUM of independent normal samples gives one false alarm per `samples_between`.

    Siegmund's approximation: Sequential Analysis (1985), equation (2.57), with the correction of 1.166.
    """

    def too_long(limit: float) -> float:
        b = limit + 1.166
        one_sided = (math.exp(2 * reference * b) - 2 * reference * b - 1) / (2 * reference**2)
        return one_sided / 2 - samples_between

    return float(root_scalar(too_long, bracket=(0.0, 200.0)).root)


def plain_methods(rate_hz: float, alarms_per_hour: float) -> list[Method]:
    """All but the filtered balance. alarms_per_hour: the budget per fan."""
    every_samples = rate_hz * 3600.0 / alarms_per_hour
    return [
        Method("+-2 sigma, as published", lambda _: Band(), PUBLISHED_BAND, is_fixed=True),
        Method("+-k sigma", lambda _: Band()),
        Method("windowed Gaussian", lambda _: WindowedGaussian(rate_hz)),
        Method("CUSUM, textbook limit", Cusum, textbook_cusum_limit(every_samples), is_fixed=True),
        Method("CUSUM", Cusum),
    ]
