"""How healthy residuals vary: over speed, in motion, in time, and from run to run."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from scipy.optimize import brentq
from scipy.stats import t

from schemas.messages import Array
from scoring.baseline.fan_offsets import FULL_S, MIN_S
from scoring.baseline.healthy_residual import HealthyResidual
from scoring.baseline.settings import BaselineSettings
from scoring.calibration.healthy_statistics import HealthyStatistics, Runs, healthy_statistics
from scoring.calibration.residual_moments import MOTION_BINS, SPEED_BINS, ResidualMoments
from scoring.detectors.detector import UNREACHED, Signal
from scoring.fan_scorer import RESIDUALS
from scoring.limits import Limits

KNOT_S = 300.0  # of healthy running for each point of a curve over speed
MAX_AUTOCORRELATION_TIME_S = 1000.0
BASELINE_MARGIN, BASELINE_COVERAGE = 1.5, 0.999
MIN_RUNS, FEW_RUNS_LIMIT_SIGMAS = (
    3,
    5.0,
)  # with fewer runs the limit is this many sigma, or three times the largest offset
SPEED_EXPONENT = 2  # of the drag, which another density of the air changes
MAX_REMAINING_SQUARE = 0.97  # baselines follow the speed if they leave at most so much of the mean square over seconds
TRANSIENT_ALLOWANCE = 3.0  # times the mean square in motion: one fan has the same error in each transient
MAX_RIDGE, INITIAL_RIDGE = 1.0, 0.1
SHORT_SHARE = 0.5  # of the mean time of the fans at a speed: a fan counts with this, or with MIN_S if that is less
UNLIMITED = BaselineSettings(commissioning_limit_sigmas=UNREACHED, adaptation_limit_sigmas=UNREACHED)


def baselines_over_speed(
    runs: Runs, limits: Limits, found: HealthyStatistics, crossover_speed_rad_s: float | None, *, has_drive: bool
) -> tuple[HealthyStatistics, dict[Signal, dict[str, Any]]]:
    """Whether the offset of a fan changes with its speed, for each residual.

    It does if subtracting such a baseline leaves less variation over the runs. Few runs say little about the
    differences between days: then it is assumed not to, but for fans with a drive of their own. What changes such a fan
    (its air, its supply, its bearing) takes a share of its speed.

    crossover_speed_rad_s: see BaselineSettings; None if it is not known.

    Returns the statistics with the chosen baselines, and the BaselineSettings that these change.
    """
    are_few = len(found.maxima) < MIN_RUNS
    if are_few and not has_drive:
        return found, {source: {} for source in RESIDUALS}
    common = {"ridge": INITIAL_RIDGE, "reference_speed_rad_s": max(found.mean_speed_rad_s, 1e-9)}
    exponent = SPEED_EXPONENT if crossover_speed_rad_s else SPEED_EXPONENT - 1
    settings: dict[Signal, dict[str, Any]] = {
        "speed": {"speed_exponent": exponent, "crossover_speed_rad_s": crossover_speed_rad_s, **common},
        "balance": {"speed_exponent": SPEED_EXPONENT, **common},
    }
    if are_few:
        settings = {source: {"speed_exponent": 1, **common} for source in RESIDUALS}
    following = {source: with_baseline(limits.residual(source), settings[source]) for source in RESIDUALS}
    other = healthy_statistics(runs, limits.model_copy(update=following), found.top_speed_rad_s)
    for source in RESIDUALS:
        moments = other.moments[source]
        remaining_square = moments.mean_second_square()
        if not are_few and remaining_square >= MAX_REMAINING_SQUARE * found.moments[source].mean_second_square():
            settings[source] = {}
            continue
        found.moments[source] = moments
        of_baselines = float(np.square(np.concatenate(moments.baselines)).mean()) if moments.count.sum() else 0.0
        settings[source]["rms_sigmas"] = math.sqrt(of_baselines)
        if not are_few:
            settings[source]["ridge"] = min(moments.typical_second_square() / max(of_baselines, 1e-12), MAX_RIDGE)
    return found, settings


def with_baseline(residual: HealthyResidual, changes: dict[str, Any]) -> HealthyResidual:
    """The same with other settings of the baseline."""
    return residual.model_copy(update={"baseline": residual.baseline.model_copy(update=changes)})


def variation(found: HealthyStatistics, source: Signal) -> HealthyResidual | None:
    """How the healthy residual varies over speed, in time, and from run to run; None where it was never valid."""
    moments = found.moments[source]
    if not moments.count.sum():
        return None
    speeds, means, deviations = _over_speed(moments, found)
    deviation = math.sqrt(max(moments.square.sum() / moments.count.sum(), 1e-12))
    of_means = math.sqrt(moments.second_mean_square / moments.seconds) / deviation if moments.seconds else 0.0
    return HealthyResidual(
        speeds_rad_s=speeds,
        expected_residual_sigmas=means,
        residual_std=deviations,
        autocorrelation_time_s=_autocorrelation_time_s(of_means**2, found.period_s),
        transient_scale_rad_s=_transient_scale_rad_s(moments.by_motion),
        baseline=UNLIMITED.model_copy(update={"commissioning_limit_sigmas": _largest_baseline(moments.baselines)}),
    )


def _transient_scale_rad_s(by_motion: Array) -> float | None:
    """The motion at which the variance of the low-passed residual is twice that of the half that moves least."""
    count, motions, squares = by_motion
    half = int(np.searchsorted(np.cumsum(count), 0.5 * count.sum())) + 1
    least = squares[:half].sum() / max(count[:half].sum(), 1.0)
    use = np.arange(MOTION_BINS) >= half
    use &= count > 0
    if not use.any() or least <= 0.0:
        return None
    squared = motions[use] / count[use]
    rise = float((squared * (squares[use] - count[use] * least)).sum() / (count[use] * squared**2).sum())
    return math.sqrt(least / (TRANSIENT_ALLOWANCE * rise)) if rise > 0.0 else None


def _largest_baseline(runs: list[Array]) -> float:
    """How far the baseline of one more healthy run may be from zero: a prediction interval, by Student's t.

    runs: baselines of the fans of each. Those of one run are of one day, and say little about other days.
    """
    baselines = np.concatenate(runs)
    few = len(runs) if len(runs) > 1 else len(baselines)
    largest = BASELINE_MARGIN * float(np.abs(baselines).max())
    if few < MIN_RUNS:
        return max(2.0 * largest, FEW_RUNS_LIMIT_SIGMAS)
    reach = float(t.ppf(0.5 + BASELINE_COVERAGE / 2, few - 1) * baselines.std(ddof=1) * math.sqrt(1.0 + 1.0 / few))
    return max(largest, abs(float(baselines.mean())) + reach, 1.0)


def persistent_std(residual: HealthyResidual, moments: ResidualMoments, top_speed_rad_s: float) -> tuple[float, ...]:
    """Standard deviation of the low-passed residual at the speeds of the residual, relative to its median, at least
    one.
    """
    count, squares = moments.smoothed_by_speed
    centre = (np.arange(SPEED_BINS) + 0.5) / SPEED_BINS * top_speed_rad_s
    nearest = np.abs(centre[:, np.newaxis] - np.array(residual.speeds_rad_s)).argmin(axis=1)
    knots = len(residual.speeds_rad_s)
    counts = np.bincount(nearest, count, minlength=knots)
    means = np.bincount(nearest, squares, minlength=knots) / np.maximum(counts, 1.0)
    median = float(np.median(means[counts > 0])) if counts.any() else 0.0
    if median <= 0.0:
        return (1.0,)
    return tuple(np.sqrt(np.maximum(means / median, 1.0)).tolist())


def _over_speed(
    moments: ResidualMoments, found: HealthyStatistics
) -> tuple[tuple[float, ...], tuple[float, ...], tuple[float, ...]]:
    """Speeds, means and standard deviations, each of enough healthy running; one speed where there is little."""
    centre = found.centres_rad_s
    groups: list[list[int]] = [[]]
    for number in range(SPEED_BINS):
        groups[-1].append(number)
        if moments.count[groups[-1]].sum() * found.period_s >= KNOT_S:
            groups.append([])
    if len(groups) > 1:
        last = groups.pop()
        groups[-1] += last
    speeds, means, deviations = [], [], []
    for group in groups:
        count = max(moments.count[group].sum(), 1.0)
        mean = float(moments.total[group].sum() / count) if len(groups) > 1 else 0.0
        speeds.append(float((moments.count[group] * centre[group]).sum() / count))
        means.append(_mean_over_fans(moments, group, found.period_s) if len(groups) > 1 else 0.0)
        deviations.append(math.sqrt(max(float(moments.square[group].sum() / count) - mean**2, 1e-6)))
    return tuple(speeds), tuple(means), tuple(deviations)


def _mean_over_fans(moments: ResidualMoments, bins: list[int], period_s: float) -> float:
    """What the residuals of all fans have in common at some speeds; a fan that did not turn there counts as zero.

    Two fans differ by more than what all of them have in common: the error of one that alone was there says nothing
    about the others.
    """
    scored = [of_fan for of_fan in moments.of_fans.values() if of_fan[0].any()]
    count, total = np.stack([of_fan[:, bins].sum(axis=1) for of_fan in scored], axis=1)
    seconds = count * period_s
    weight = np.where(seconds >= min(MIN_S, SHORT_SHARE * seconds.mean()), np.minimum(seconds, FULL_S), 0.0)
    share = float((weight > 0.0).mean())
    return share * float((weight * total / np.maximum(count, 1.0)).sum() / max(weight.sum(), 1e-9))


def between_runs_std(moments: ResidualMoments, residual: HealthyResidual) -> float:
    """Standard deviation of healthy baselines, in that of the residual: a shift of this size is not a drift yet."""
    return float(np.concatenate(moments.baselines).std()) / residual.mean_residual_std


def _autocorrelation_time_s(variance_of_means: float, period_s: float) -> float:
    """Of a first-order residual whose means over a second have this variance, relative to its own."""

    def beyond(time_s: float) -> float:
        kept = math.exp(-1.0 / time_s)
        return 2.0 * time_s * (1.0 - time_s * (1.0 - kept)) - variance_of_means

    if variance_of_means <= period_s or beyond(0.5 * period_s) >= 0.0:
        return 0.0
    if beyond(MAX_AUTOCORRELATION_TIME_S) <= 0.0:
        return MAX_AUTOCORRELATION_TIME_S
    found: Any = brentq(beyond, 0.5 * period_s, MAX_AUTOCORRELATION_TIME_S)
    return float(found)
