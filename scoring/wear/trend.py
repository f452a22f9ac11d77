"""Trend of a slow change per day with its confidence interval, and when it will reach a limit.

Points are (time, value, standard error). Memory is bounded: when the series is full, neighbours are merged in pairs,
and from then on a stored point is the mean of twice as many. A complete point is kept to the second, its value to a
hundredth of its standard error: all digits would be most of a snapshot, and say nothing.

Slope: the median of the slopes between all pairs of points (Theil 1950; Sen, JASA 63 (1968) 1379), which tolerates 29 %
of outliers. Interval: the errors of a fan are correlated over hours (temperature, day and night), so that successive
points count for less. The means of at least BATCHES intervals show how much less (batch means, as for the output of
simulations: Law, Simulation Modeling and Analysis, 2015, section 9.5.3). Means that are still correlated count as (1 -
rho) / (1 + rho) each, where rho is their lag-one correlation, corrected for the bias of a short series (Marriott and
Pope, Biometrika 41 (1954) 390; the effective number as in Yue and Wang, Water Resources Management 18 (2004) 201). The
interval is that of a regression line by Student's t with this effective number; the scatter is estimated by the median
absolute deviation and is at least the points' own errors.

A limit is reached between the earliest and the latest time at which the line with its uncertainty crosses it (Fieller).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from pydantic import FiniteFloat

from fantwin.schemas.messages import Array
from fantwin.schemas.units import NS_PER_S
from fantwin.scoring.model.population import Positive

NS_PER_DAY = 86_400 * NS_PER_S
CAPACITY = 128
MIN_POINTS = 10
MAX_ERROR_RATIO = 3.0
"""ratio to the median error of the points; a trend leaves out those with larger errors"""
MIN_EFFECTIVE_POINTS = 5.0
BATCHES = 24
MIN_FORECAST_DAYS = 1.0
"""observed time before the first forecast: weather and warming bearings change more within a day than wear does"""
MAX_HORIZON_RATIO = 10.0
"""horizon of the forecast of a limit, in multiples of the observed time"""
REACHED = "the limit is already reached"
THEIL_SEN_EFFICIENCY = 3.0 / np.pi
SCATTER_PER_MEDIAN = 1.4826


@dataclass(frozen=True)
class Trend:
    """A line through the points, at days since `origin_ns`, the mean of their times.

    slope_per_day with its 95 % interval (low, high). level, level_error: the line at the origin. t_quantile: half the
    95 % interval in standard errors. days: observed time.
    """

    origin_ns: int
    slope_per_day: float
    low: float
    high: float
    slope_error: float
    level: float
    level_error: float
    t_quantile: float
    days: float

    @property
    def significant(self) -> bool:
        """Return whether the slope differs from zero at 95 % confidence."""
        return self.low > 0.0 or self.high < 0.0


@dataclass(frozen=True)
class LimitForecast:
    """Forecast of when a limit will be reached (95 %: earliest to latest), or why that is unknown."""

    earliest_ns: int | None = None
    likely_ns: int | None = None
    latest_ns: int | None = None
    unknown_reason: str = ""


class Point(NamedTuple):
    """Value of a series, or the mean of several."""

    t_ns: int
    value: float
    std_error: float


@dataclass
class WearSeries:
    """The points of one fan, at most CAPACITY: a column of each of their fields."""

    t_ns: list[int]
    value: list[FiniteFloat]
    std_error: list[Positive]
    points_per_stored: int = 1
    points_in_last: int = 0
    """points in the last stored one, which may be incomplete"""

    def __post_init__(self) -> None:
        """Raises ValueError: it is damaged."""
        if not len(self.t_ns) == len(self.value) == len(self.std_error) <= CAPACITY:
            raise ValueError("columns of different lengths, or too many points")

    def __len__(self) -> int:
        return len(self.t_ns)

    @property
    def points(self) -> list[Point]:
        """The points, oldest first."""
        return list(map(Point, self.t_ns, self.value, self.std_error))

    @points.setter
    def points(self, points: Sequence[Point]) -> None:
        self.t_ns, self.value, self.std_error = map(list, zip(*points, strict=True))

    def add(self, t_ns: int, value: float, std_error: float) -> bool:
        """Add a point. False, and nothing is added: it is not finite, not newer than the last, or without an error."""
        is_newer = not self.t_ns or t_ns > self.t_ns[-1]
        if not (is_newer and math.isfinite(value) and math.isfinite(std_error) and std_error > 0.0):
            return False
        points, point = self.points, Point(t_ns, value, std_error)
        if 0 < self.points_in_last < self.points_per_stored:
            points[-1] = mean_of([points[-1], point], [self.points_in_last, 1])
            self.points_in_last += 1
        else:
            if len(points) == CAPACITY:
                points = [_rounded(mean_of(pair)) for pair in zip(points[::2], points[1::2], strict=True)]
                self.points_per_stored *= 2
            points.append(point)
            self.points_in_last = 1
        if self.points_in_last == self.points_per_stored:
            points[-1] = _rounded(points[-1])
        self.points = points
        return True

    def mean_from(self, from_ns: int, days: float) -> Point:
        """The mean of the points of some days, or the next point if there is none. The series must not be empty."""
        points = self.points
        later = [point for point in points if point.t_ns >= from_ns] or points[-1:]
        until_ns = max(from_ns + round(days * NS_PER_DAY), later[0].t_ns)
        return mean_of([point for point in later if point.t_ns <= until_ns])

    def trend(self) -> Trend | None:
        """The line through the points; None while there are too few independent points."""
        std_error = np.array(self.std_error)
        largest = MAX_ERROR_RATIO * np.median(std_error) if len(std_error) else 0.0
        known = [point for point in self.points if point.std_error <= largest]
        n = len(known)
        if n < MIN_POINTS:
            return None
        from scipy import special, stats  # noqa: PLC0415  what only shows wear does without this large import

        t_ns, value = np.array([point.t_ns for point in known]), np.array([point.value for point in known])
        origin_ns = int(t_ns[0]) + round(float((t_ns - t_ns[0]).mean()))
        day = (t_ns - origin_ns) / NS_PER_DAY
        fitted: Any = stats.theilslopes(value, day)
        slope = float(fitted.slope)
        level = float(np.median(value - slope * day))
        residual = value - level - slope * day
        effective = n / _inflation(residual)
        if effective < MIN_EFFECTIVE_POINTS:
            return None
        scatter = SCATTER_PER_MEDIAN * float(np.median(np.abs(residual))) * math.sqrt(n / (n - 2.0))
        scatter = max(scatter, float(np.median(std_error[std_error <= largest])))
        level_error = scatter / math.sqrt(effective * THEIL_SEN_EFFICIENCY)
        slope_error = level_error / float(day.std())
        t_quantile = float(special.stdtrit(min(effective, n // max(1, n // BATCHES)) - 2.0, 0.975))
        return Trend(
            origin_ns=origin_ns,
            slope_per_day=slope,
            low=slope - t_quantile * slope_error,
            high=slope + t_quantile * slope_error,
            slope_error=slope_error,
            level=level,
            level_error=level_error,
            t_quantile=t_quantile,
            days=float(day[-1] - day[0]),
        )


def forecast_limit(trend: Trend, limit: float, now_ns: int) -> LimitForecast:
    """Forecast when the value will reach `limit`, which lies ahead in the direction of the trend, if the trend
    continues."""
    if trend.days < MIN_FORECAST_DAYS:
        return LimitForecast(unknown_reason="less than a day was observed")
    now = (now_ns - trend.origin_ns) / NS_PER_DAY
    distance = limit - (trend.level + trend.slope_per_day * now)
    if not trend.significant:
        return LimitForecast(unknown_reason="no significant trend")
    if distance * trend.slope_per_day <= 0.0:
        return LimitForecast(unknown_reason=REACHED)
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
    root = math.sqrt(max(b * b - 4.0 * a * c, 0.0))
    return (-b - root) / (2.0 * a), (-b + root) / (2.0 * a)


def _inflation(residual: Array) -> float:
    """Number of correlated points that count as one."""
    bounded = np.clip(residual, *np.quantile(residual, (0.02, 0.98)))
    size = max(1, len(residual) // BATCHES)
    n = len(residual) // size
    batches = bounded[len(residual) - n * size :].reshape(n, size).mean(axis=1)
    batches = batches - batches.mean()
    power = float(batches @ batches)
    found = float(batches[:-1] @ batches[1:]) / power if power > 0.0 else 0.0
    # Fitting a line lowers the measured correlation by about that of two means.
    rho = np.clip(found + 2.0 * (1.0 + 3.0 * max(found, 0.0)) / n, 0.0, 1.0 - 1.0 / n)
    within = size * (power / (n - 2.0)) / float(bounded.var()) if power > 0.0 else 1.0
    return float(max(within, 1.0) * (1.0 + rho) / (1.0 - rho))


def mean_of(points: Sequence[Point], counts: Iterable[int] = itertools.repeat(1)) -> Point:
    """The mean of points, each itself the mean of `counts`, weighted by their inverse variances.

    Points of a filter err alike, so a mean is as uncertain as what it is made of.
    """
    first_ns, total, value, later_ns, of_counts = points[0].t_ns, 0.0, 0.0, 0.0, 0
    for point, count in zip(points, counts, strict=False):
        weight = count / point.std_error**2
        total, of_counts = total + weight, of_counts + count
        value, later_ns = value + weight * point.value, later_ns + weight * (point.t_ns - first_ns)
    return Point(first_ns + round(later_ns / total), value / total, math.sqrt(of_counts / total))


def _rounded(point: Point) -> Point:
    """A point to the second, its value to a hundredth of its standard error or finer, and that to three digits."""
    digits = 2 - math.floor(math.log10(point.std_error))
    t_ns = point.t_ns // NS_PER_S * NS_PER_S
    return Point(t_ns, round(point.value, digits), round(point.std_error, digits))
