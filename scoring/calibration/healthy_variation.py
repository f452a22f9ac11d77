"""How healthy residuals vary, by what a survey found: over speeds, in motion, in time, and from run to run."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from scipy.optimize import brentq
from scipy.stats import t

from schemas.messages import Array
from scoring.calibration.healthy_statistics import MOTION_BINS, RESIDUALS, SPEED_BINS, Healthy, Moments, Runs, survey
from scoring.limits import Limits, ResidualLimits

FAR = 1e6  # a limit that nothing reaches
KNOT_S = 300.0  # of healthy running for each point of the curve over speed
LONGEST_S = 1000.0  # of a residual's memory
BASELINE_MARGIN, BASELINE_COVERAGE = 1.5, 0.999
LEAST_BASELINES, FEW_BASELINES = 3, 5.0  # fewer say little of days: then so many sigma, or three times what was seen
POWER = 2  # of the speed, that the balance goes with when the air is lighter or heavier; the speed too, up to its bend
GAIN = 0.97  # of the mean square over seconds, at most, for them to be taken
UNLIKE = 3.0  # of the mean square in motion: what one fan is wrong by on its way, it is each time, and others are not
MOST_RIDGE, USUAL_RIDGE = 1.0, 0.1


def open_limits(limits: ResidualLimits) -> ResidualLimits:
    """The same with statistics that no residual takes to their limits."""
    return limits.model_copy(
        update={"step": FAR, "drift": FAR, "growth": FAR, "baseline_sigmas": FAR, "adaptation_sigmas": FAR}
    )


def followed(
    runs: Runs, limits: Limits, found: Healthy, bend_rad_s: float | None
) -> tuple[Healthy, dict[str, dict[str, Any]]]:
    """Whether a fan's own offset goes with the speed, of each residual; and what baselines then leave.

    bend_rad_s: of what a little more speed needs the drag makes half there; None where that is not known.

    It is taken to, when the healthy residual less such a baseline varies less; not by a few runs, which say little of
    days.
    """
    if len(found.maxima) < LEAST_BASELINES:
        return found, {name: {} for name in RESIDUALS}
    reference = {"baseline_speed_rad_s": max(found.mean_speed_rad_s, 1e-9)}
    powers: dict[str, dict[str, Any]] = {
        "speed": {"baseline_power": POWER if bend_rad_s else POWER - 1, "baseline_bend_rad_s": bend_rad_s},
        "balance": {"baseline_power": POWER},
    }
    powers = {name: {**powers[name], "baseline_ridge": USUAL_RIDGE, **reference} for name in RESIDUALS}
    moving = {name: getattr(limits, name).model_copy(update=powers[name]) for name in RESIDUALS}
    other = survey(runs, limits.model_copy(update=moving), found.top_speed_rad_s)
    for name in RESIDUALS:
        if other.moments[name].left() < GAIN * found.moments[name].left():
            found.moments[name] = moments = other.moments[name]
            of_baselines = float(np.square(np.concatenate(moments.baselines)).mean())
            powers[name]["baseline_ridge"] = min(moments.usually_left() / max(of_baselines, 1e-12), MOST_RIDGE)
            powers[name]["baseline_usual_sigmas"] = math.sqrt(of_baselines)
        else:
            powers[name] = {}
    return found, powers


def shape(found: Healthy, name: str) -> ResidualLimits:
    """How the healthy residual varies: over speeds, in time, and from run to run."""
    moments = found.moments[name]
    if not moments.count.sum():
        return ResidualLimits(baseline_sigmas=FAR, adaptation_sigmas=FAR)
    speeds, offsets, spreads = _over_speeds(moments, found)
    deviation = math.sqrt(max(moments.square.sum() / moments.count.sum(), 1e-12))
    of_means = math.sqrt(moments.mean_square / moments.means) / deviation if moments.means else 0.0
    return open_limits(
        ResidualLimits(
            speeds_rad_s=speeds,
            offset_sigmas=offsets,
            spread=spreads,
            autocorrelation_time_s=_memory_s(of_means**2, found.step_s),
            motion_rad_s=_motion_rad_s(moments.moved),
        )
    ).model_copy(update={"baseline_sigmas": _farthest(moments.baselines)})


def _motion_rad_s(moved: Array) -> float | None:
    """The motion at which the variance of the low-passed residual is twice that of the half that moves least."""
    count, motions, squares = moved
    half = int(np.searchsorted(np.cumsum(count), 0.5 * count.sum())) + 1
    least = squares[:half].sum() / max(count[:half].sum(), 1.0)
    use = np.arange(MOTION_BINS) >= half
    use &= count > 0
    if not use.any() or least <= 0.0:
        return None
    squared = motions[use] / count[use]
    rise = float((squared * (squares[use] - count[use] * least)).sum() / (count[use] * squared**2).sum())
    return math.sqrt(least / (UNLIKE * rise)) if rise > 0.0 else None


def _farthest(runs: list[Array]) -> float:
    """How far the baseline of one more healthy run may be from none: a prediction interval, by Student's t.

    runs: baselines of the fans of each. Those of one run are of one day, and say little of others.
    """
    baselines = np.concatenate(runs)
    few = len(runs) if len(runs) > 1 else len(baselines)
    largest = BASELINE_MARGIN * float(np.abs(baselines).max())
    if few < LEAST_BASELINES:
        return max(2.0 * largest, FEW_BASELINES)
    reach = float(t.ppf(0.5 + BASELINE_COVERAGE / 2, few - 1) * baselines.std(ddof=1) * math.sqrt(1.0 + 1.0 / few))
    return max(largest, abs(float(baselines.mean())) + reach, 1.0)


def lasting(limits: ResidualLimits, moments: Moments, top_speed_rad_s: float) -> tuple[float, ...]:
    """At the speeds of the limits, how much more than usual what lasts of the residual varies; never less."""
    count, squares = moments.lasting
    centre = (np.arange(SPEED_BINS) + 0.5) / SPEED_BINS * top_speed_rad_s
    near = np.abs(centre[:, np.newaxis] - np.array(limits.speeds_rad_s)).argmin(axis=1)
    knots = len(limits.speeds_rad_s)
    counts = np.bincount(near, count, minlength=knots)
    means = np.bincount(near, squares, minlength=knots) / np.maximum(counts, 1.0)
    usual = float(np.median(means[counts > 0])) if counts.any() else 0.0
    if usual <= 0.0:
        return (1.0,)
    return tuple(np.sqrt(np.maximum(means / usual, 1.0)).tolist())


def _over_speeds(moments: Moments, found: Healthy) -> tuple[tuple[float, ...], tuple[float, ...], tuple[float, ...]]:
    """Knots, means and standard deviations, each of enough healthy running; one knot where there is little."""
    centre = found.centres_rad_s
    groups: list[list[int]] = [[]]
    for number in range(SPEED_BINS):
        groups[-1].append(number)
        if moments.count[groups[-1]].sum() * found.step_s >= KNOT_S:
            groups.append([])
    if len(groups) > 1:
        last = groups.pop()
        groups[-1] += last
    speeds, offsets, spreads = [], [], []
    for group in groups:
        count = max(moments.count[group].sum(), 1.0)
        mean = float(moments.total[group].sum() / count)
        speeds.append(float((moments.count[group] * centre[group]).sum() / count))
        offsets.append(mean if len(groups) > 1 else 0.0)
        spreads.append(math.sqrt(max(float(moments.square[group].sum() / count) - offsets[-1] ** 2, 1e-6)))
    return tuple(speeds), tuple(offsets), tuple(spreads)


def between_runs(found: Healthy, name: str, limits: ResidualLimits) -> float:
    """How far healthy baselines lie from their mean, in standard deviations: a shift as large is no drift yet."""
    return float(np.concatenate(found.moments[name].baselines).std()) / limits.mean_spread


def _memory_s(variance_of_means: float, step_s: float) -> float:
    """Autocorrelation time of a first-order residual whose means over a second vary so, as a share of its variance."""

    def beyond(memory_s: float) -> float:
        kept = math.exp(-1.0 / memory_s)
        return 2.0 * memory_s * (1.0 - memory_s * (1.0 - kept)) - variance_of_means

    if variance_of_means <= step_s or beyond(0.5 * step_s) >= 0.0:
        return 0.0
    if beyond(LONGEST_S) <= 0.0:
        return LONGEST_S
    found: Any = brentq(beyond, 0.5 * step_s, LONGEST_S)
    return float(found)
