"""Slow wear: the trend of a parameter per day with its confidence interval, and when it will reach a limit.

Points are (time, value, standard error). Memory is bounded: when the series is full, neighbours are merged in pairs,
and from then on a stored point is the mean of twice as many. A complete point is kept to the second, its value to a
hundredth of its standard error: all digits would be most of a snapshot, and say nothing.

Slope: the median of the slopes between all pairs of points (Theil 1950; Sen, JASA 63 (1968) 1379), which tolerates a
third of outliers. Interval: residuals of a fan are correlated over hours (temperature, day and night), so that
successive points count for less. The means of at least BATCHES stretches show how much less (batch means, as for the
output of simulations: Law, Simulation Modeling and Analysis, 2015, section 9.5.3). Stretches that are still correlated
count as (1 - rho) / (1 + rho) each, where rho is their lag-one correlation, corrected for the bias of a short series
(Marriott and Pope, Biometrika 41 (1954) 390; the effective number as in Yue and Wang, Water Resources Management 18
(2004) 201). The interval is that of a regression line by Student's t with this effective number; the scatter is
estimated by the median absolute deviation and is at least the points' own errors.

A limit is reached between the earliest and the latest time at which the line with its uncertainty crosses it (Fieller).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from schemas.units import NS_PER_S

Array = NDArray[np.float64]

NS_PER_DAY = 86_400 * NS_PER_S
CAPACITY = 128
MIN_POINTS = 10
MAX_ERROR_RATIO = 3.0
"""to the median error of the points; those with larger errors say nothing, and are left out of a trend"""
MIN_EFFECTIVE_POINTS = 5.0
BATCHES = 24
MAX_HORIZON_RATIO = 10.0
"""no forecast of a limit farther ahead than this many times the observed time"""
THEIL_SEN_EFFICIENCY = 3.0 / np.pi
SCATTER_PER_MEDIAN = 1.4826


@dataclass(frozen=True)
class Trend:
    """A line through the points, at days since `origin_ns`, the mean of their times.

    first_ns: of the first point. slope_per_day with its 95 % interval (low, high). level, level_error: the line at the
    origin. t_quantile: half the 95 % interval in standard errors. days: observed time.
    """

    origin_ns: int
    first_ns: int
    slope_per_day: float
    low: float
    high: float
    slope_error: float
    level: float
    level_error: float
    t_quantile: float
    points: int
    days: float

    @property
    def significant(self) -> bool:
        """Whether the slope differs from zero at 95 % confidence."""
        return self.low > 0.0 or self.high < 0.0


@dataclass(frozen=True)
class LimitForecast:
    """When a limit will be reached (95 %: earliest to latest), or why that is unknown."""

    earliest_ns: int | None = None
    likely_ns: int | None = None
    latest_ns: int | None = None
    unknown_reason: str = ""


class WearSeries:
    """The points of one parameter of one fan."""

    def __init__(self) -> None:
        self._t_ns: list[int] = []
        self._value: list[float] = []
        self._std_error: list[float] = []
        self._points_per_stored = 1
        self._points_in_last = 0  # the last stored point may still be incomplete

    def __len__(self) -> int:
        return len(self._t_ns)

    @property
    def last(self) -> float:
        """The last value; 0 if there is none."""
        return self._value[-1] if self._value else 0.0

    def add(self, t_ns: int, value: float, std_error: float) -> None:
        """Add a point. It is ignored if not finite, not newer than the last, or without a positive std_error."""
        if not (np.isfinite(value) and np.isfinite(std_error) and std_error > 0.0):
            return
        if self._t_ns and t_ns <= self._t_ns[-1]:
            return
        if 0 < self._points_in_last < self._points_per_stored:
            self._points_in_last += 1
            self._t_ns[-1], self._value[-1], self._std_error[-1] = _merged(
                (self._t_ns[-1], self._value[-1], self._std_error[-1]), (t_ns, value, std_error)
            )
        else:
            if len(self._t_ns) == CAPACITY:
                self._halve()
            self._t_ns.append(t_ns)
            self._value.append(value)
            self._std_error.append(std_error)
            self._points_in_last = 1
        if self._points_in_last == self._points_per_stored:
            self._t_ns[-1], self._value[-1], self._std_error[-1] = _rounded(
                (self._t_ns[-1], self._value[-1], self._std_error[-1])
            )

    def trend(self) -> Trend | None:
        """The line through the points; None while there are too few independent points."""
        std_error = np.array(self._std_error)
        is_known = std_error <= MAX_ERROR_RATIO * np.median(std_error) if len(std_error) else np.zeros(0, bool)
        t_ns, value = np.array(self._t_ns, np.int64)[is_known], np.array(self._value)[is_known]
        n = len(t_ns)
        if n < MIN_POINTS:
            return None
        from scipy.stats import theilslopes  # noqa: PLC0415  what only shows wear does without this large import

        origin_ns = int(t_ns[0]) + round(float((t_ns - t_ns[0]).mean()))
        day = (t_ns - origin_ns) / NS_PER_DAY
        fitted: Any = theilslopes(value, day)
        slope = float(fitted.slope)
        level = float(np.median(value - slope * day))
        residual = value - level - slope * day
        effective = n / _inflation(residual)
        if effective < MIN_EFFECTIVE_POINTS:
            return None
        scatter = SCATTER_PER_MEDIAN * float(np.median(np.abs(residual))) * np.sqrt(n / (n - 2.0))
        scatter = max(scatter, float(np.median(std_error[is_known])))
        level_error = scatter / np.sqrt(effective * THEIL_SEN_EFFICIENCY)
        slope_error = level_error / float(day.std())
        t_quantile = float(stdtrit(min(effective, n // max(1, n // BATCHES)) - 2.0, 0.975))
        return Trend(
            origin_ns=origin_ns,
            first_ns=self._t_ns[0],
            slope_per_day=slope,
            low=slope - t_quantile * slope_error,
            high=slope + t_quantile * slope_error,
            slope_error=slope_error,
            level=level,
            level_error=level_error,
            t_quantile=t_quantile,
            points=n,
            days=float(day[-1] - day[0]),
        )

    def snapshot(self) -> dict[str, NDArray[np.int64] | Array]:
        """The whole state as arrays: t_ns, value, std_error (points,), and count (2,)."""
        return {
            "t_ns": np.array(self._t_ns, np.int64),
            "value": np.array(self._value, np.float64),
            "std_error": np.array(self._std_error, np.float64),
            "count": np.array((self._points_per_stored, self._points_in_last), np.int64),
        }

    @classmethod
    def restore(cls, snapshot: Mapping[str, NDArray]) -> WearSeries:
        """The series of a snapshot.

        Raises:
            ValueError, KeyError, TypeError: it is not a snapshot of a series.
        """
        series = cls()
        series._t_ns = [int(t_ns) for t_ns in snapshot["t_ns"]]
        series._value = [float(value) for value in snapshot["value"]]
        series._std_error = [float(error) for error in snapshot["std_error"]]
        if not len(series._t_ns) == len(series._value) == len(series._std_error) <= CAPACITY:
            raise ValueError("columns of a series must be of one length")
        series._points_per_stored, series._points_in_last = (int(count) for count in snapshot["count"])
        return series

    def _halve(self) -> None:
        points = list(zip(self._t_ns, self._value, self._std_error, strict=True))
        pairs = [_rounded(_merged(first, second)) for first, second in zip(points[::2], points[1::2], strict=True)]
        self._t_ns, self._value, self._std_error = (list(column) for column in zip(*pairs, strict=True))
        self._points_per_stored *= 2


def forecast_limit(trend: Trend, limit: float, now_ns: int) -> LimitForecast:
    """When the parameter will reach `limit`, from either side, if the trend continues."""
    now = (now_ns - trend.origin_ns) / NS_PER_DAY
    level_now = trend.level + trend.slope_per_day * now
    distance = limit - level_now
    if not trend.significant:
        return LimitForecast(unknown_reason="no significant trend")
    if distance * trend.slope_per_day <= 0.0:
        first_distance = limit - (trend.level + trend.slope_per_day * (now - trend.days))
        passed = first_distance * trend.slope_per_day > 0.0
        return LimitForecast(
            unknown_reason="the limit is already reached" if passed else "it moves away from the limit"
        )
    likely = (limit - trend.level) / trend.slope_per_day
    if likely - now > MAX_HORIZON_RATIO * trend.days:
        return LimitForecast(
            unknown_reason=f"more than {MAX_HORIZON_RATIO:g} times as far ahead as the {trend.days:.2g} days observed"
        )
    earliest, latest = _crossings(trend, limit)
    earliest_ns, likely_ns, latest_ns = (
        trend.origin_ns + round(max(day, now) * NS_PER_DAY) for day in (earliest, likely, latest)
    )
    return LimitForecast(earliest_ns, likely_ns, latest_ns)


def _crossings(trend: Trend, limit: float) -> tuple[float, float]:
    """Days since the origin at which the two edges of the line's 95 % interval are at the limit.

    They are the solutions x of (limit - level - slope x)^2 = t^2 (level_error^2 + slope_error^2 x^2) with t the
    t_quantile; they are real because the slope is significant.
    """
    distance = limit - trend.level
    a = trend.slope_per_day**2 - (trend.t_quantile * trend.slope_error) ** 2
    b = -2.0 * distance * trend.slope_per_day
    c = distance**2 - (trend.t_quantile * trend.level_error) ** 2
    root = np.sqrt(max(b * b - 4.0 * a * c, 0.0))
    return (-b - root) / (2.0 * a), (-b + root) / (2.0 * a)


def _inflation(residual: Array) -> float:
    """How many correlated points count as one."""
    bounded = np.clip(residual, *np.quantile(residual, (0.02, 0.98)))
    size = max(1, len(residual) // BATCHES)
    n = len(residual) // size
    batches = bounded[len(residual) - n * size :].reshape(n, size).mean(axis=1)
    batches = batches - batches.mean()
    power = float(batches @ batches)
    found = float(batches[:-1] @ batches[1:]) / power if power > 0.0 else 0.0
    # Fitting a line lowers the measured correlation by about that of two stretches.
    rho = np.clip(found + 2.0 * (1.0 + 3.0 * max(found, 0.0)) / n, 0.0, 1.0 - 1.0 / n)
    within = size * (power / (n - 2.0)) / float(bounded.var()) if power > 0.0 else 1.0
    return float(max(within, 1.0) * (1.0 + rho) / (1.0 - rho))


def _merged(first: tuple[int, float, float], second: tuple[int, float, float]) -> tuple[int, float, float]:
    """The mean of two points, weighted by their inverse variances."""
    weights = np.array((first[2] ** -2, second[2] ** -2))
    share = float(weights[1] / weights.sum())
    t_ns = first[0] + round(share * (second[0] - first[0]))
    return t_ns, first[1] + share * (second[1] - first[1]), float(weights.sum() ** -0.5)


def _rounded(point: tuple[int, float, float]) -> tuple[int, float, float]:
    """A point to the second, its value to a hundredth of its standard error or finer, and that to three digits."""
    t_ns, value, std_error = point
    digits = 2 - math.floor(math.log10(std_error))
    return t_ns // NS_PER_S * NS_PER_S, round(value, digits), round(std_error, digits)
