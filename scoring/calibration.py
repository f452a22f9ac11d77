"""Limits from healthy running, such that alarms come as rarely as declared.

A healthy recording is judged as a live fan is: commissioned at its start, baselines followed, statistics run. Of every
window of ten seconds the highest value is kept that each statistic held for the on-delay. Limits are where these are
equally rare for every statistic, and so rare that the whole, which is an alarm, comes as often as declared: how much
oftener than one statistic alone is counted at lower limits. An excursion over several windows is one alarm. Where a
limit lies beyond all that was seen it is put at the safe end of what the tail says. The interval of the rate is by the
alarms that these limits would have raised, see scoring.alarm_rate: blocks are whole runs where there are enough of
them, fans of runs or minutes where not.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.optimize import brentq
from scipy.stats import t

from schemas.messages import Array, Statistic
from scoring.alarm_rate import rate_interval
from scoring.judge import Judge, Samples
from scoring.limits import Limits, Promise, ResidualLimits, Timing, smoothed_deviation
from scoring.tail import Tail
from scoring.windows import Windows, peaks

DAY_S = 86_400.0
FAR = 1e6  # a limit that nothing reaches
NEEDED_ALARMS = 3.0  # false alarms expected in the healthy data, for their rate to be told from other rates
SPEED_BINS = 24
KNOT_S = 300.0  # of healthy running for each point of the curve over speed
ENOUGH_BLOCKS = 8
LEAST_WINDOWS = 6
WINDOWS_OF_BLOCK = 6  # a minute
MOST_LIKELY = 0.25  # a window with an alarm may not be likelier: the limits would be within the noise
LEAST_LIMIT = 0.1
LEAST = (4.0, 2.0, 2.5)  # limits of step, drift and growth: what is nearer is within every healthy fan's reach
WILD = 100.0  # sigma; a larger residual counts as this
LEAST_GROWTH = 0.01
LONGEST_S = 1000.0  # of a residual's memory
STUCK_MARGIN, LEAST_STUCK_S = 3.0, 2.0
MISSING_MARGIN, LEAST_MISSING, MOST_MISSING = 3.0, 0.25, 0.9
BASELINE_MARGIN, BASELINE_COVERAGE = 1.5, 0.999
LEAST_BASELINES, FEW_BASELINES = 3, 5.0  # fewer say little of days: then so many sigma, or three times what was seen
SHARE_OF_STEP = 0.25  # the CUSUM's reference value, of the limit of the step
RESIDUALS = ("speed", "balance")
STATISTICS = 7
FIRST = (Statistic.SPEED_STEP - 1, Statistic.BALANCE_STEP - 1)
SEEN_WINDOWS = 50.0  # with an alarm, to count how often statistics alarm together
SCORE = 7  # after the statistics

Runs = Callable[[], Iterable[tuple[int, Iterable[Samples]]]]
"""At each call the healthy runs from the beginning: how many fans, and the blocks."""


class TooLittleError(Exception):
    """The healthy running cannot support what is to be declared."""

    def __init__(self, fan_hours: float, needed_fan_hours: float, least_per_day: float) -> None:
        super().__init__(fan_hours, needed_fan_hours)
        self.fan_hours = fan_hours
        self.needed_fan_hours = needed_fan_hours
        self.least_per_day = least_per_day
        """the lowest rate that can be declared with what is there"""


@dataclass
class _Moments:
    """Of one residual over bins of speed: counts, sums, sums of squares; and of means over a second."""

    count: Array = field(default_factory=lambda: np.zeros(SPEED_BINS))
    total: Array = field(default_factory=lambda: np.zeros(SPEED_BINS))
    square: Array = field(default_factory=lambda: np.zeros(SPEED_BINS))
    means: int = 0
    mean_square: float = 0.0
    baselines: list[Array] = field(default_factory=list)
    growth: float = 0.0
    """sum of the spread, in its limit"""


@dataclass
class Healthy:
    """What one pass over the healthy runs has found. maxima: by run, (windows, 8, fans), see scoring.windows."""

    top_speed_rad_s: float
    step_s: float = 0.0
    maxima: list[Array] = field(default_factory=list)
    moments: dict[str, _Moments] = field(default_factory=lambda: {name: _Moments() for name in RESIDUALS})
    fan_s: float = 0.0
    stuck_s: float = 0.0
    missing: float = 0.0

    def peaks(self, row: int) -> Array:
        """(windows of fans,) of one statistic, or the score as the last."""
        every = np.concatenate([peaks(run[:, row]).ravel() for run in self.maxima])
        return every[np.isfinite(every)]

    @property
    def windows(self) -> int:
        """So many in which a fan was judged."""
        return sum(int(np.isfinite(run[:, -1]).sum()) for run in self.maxima)


def calibrate(
    runs: Runs,
    top_speed_rad_s: float,
    timing: Timing,
    false_alarms_per_day: float,
    seed: int = 0,
    extrapolate: bool = False,
) -> Limits:
    """Limits with a declared number of false alarms per fan and day.

    Raises:
        TooLittleError: the runs are too short for that, and extrapolate is not set; or too short for anything.
    """
    limits = Limits(speed=_open(ResidualLimits()), balance=_open(ResidualLimits()), timing=timing)
    limits = limits.model_copy(update={"stuck_s": FAR, "missing_share": 1.0})
    found = survey(runs, limits, top_speed_rad_s)
    needed_s = NEEDED_ALARMS * DAY_S / false_alarms_per_day
    if found.windows < LEAST_WINDOWS or (found.fan_s < needed_s and not extrapolate):
        raise TooLittleError(found.fan_s / 3600, needed_s / 3600, NEEDED_ALARMS * DAY_S / max(found.fan_s, 1.0))
    target = min(false_alarms_per_day / DAY_S * found.fan_s / found.windows, MOST_LIKELY)
    each = target / STATISTICS
    limits = limits.model_copy(
        update={
            "stuck_s": max(LEAST_STUCK_S, STUCK_MARGIN * found.stuck_s),
            "missing_share": min(MOST_MISSING, max(LEAST_MISSING, MISSING_MARGIN * found.missing)),
            **{name: _shape(found, name) for name in RESIDUALS},
        }
    )
    for drifts_too in (False, True):  # the reference value of the drift follows from the limit of the step
        found = survey(runs, limits, top_speed_rad_s)
        limits = limits.model_copy(
            update={name: _limit(getattr(limits, name), name, found, timing, each, drifts_too) for name in RESIDUALS}
        )
    found = survey(runs, limits, top_speed_rad_s)
    factors = _factors(found, target)
    for name, first in zip(RESIDUALS, FIRST, strict=True):
        scaled = getattr(limits, name).each_times(*factors[first : first + 3].tolist())
        if found.fan_s < needed_s:
            scaled = _cautious(scaled, name, found, timing)
        limits = limits.model_copy(update={name: scaled})
    promise = Promise(
        false_alarms_per_day=false_alarms_per_day,
        interval_95=_interval(found, factors, seed),
        extrapolated=found.fan_s < needed_s,
        fan_hours=found.fan_s / 3600,
        runs=len(found.maxima),
    )
    return limits.model_copy(update={"promise": promise})


def _factors(found: Healthy, target: float) -> Array:
    """(7,) by how much to multiply the limit of each statistic, so that together they are passed so often."""
    often = min(max(target, SEEN_WINDOWS / found.windows), MOST_LIKELY)
    at = np.array([_level(found, row, often / STATISTICS) for row in range(STATISTICS)])
    together = np.concatenate([peaks(_score(run, at)).ravel() for run in found.maxima])
    passed = float((together[np.isfinite(together)] > 1.0).mean())
    alike = min(max(passed / (often / STATISTICS), 1.0), float(STATISTICS))  # as so many unrelated statistics
    return np.array([_level(found, row, target / alike) for row in range(STATISTICS)])


def _cautious(limits: ResidualLimits, name: str, found: Healthy, timing: Timing) -> ResidualLimits:
    """Limits where the running is too little to set them: none nearer than `LEAST`.

    A day's own friction moves the balance alike at every speed, but not the speed. Without enough running to know how,
    a fan that goes to another speed may be as far off as other healthy runs are: the speed's step is judged from there
    on, and its drift not at all.
    """
    if limits.step is None or limits.drift is None or limits.growth is None:
        return limits
    step, drift, growth = LEAST
    if name == "speed":
        deviation = smoothed_deviation(timing.smoothing_s, limits.autocorrelation_time_s, found.step_s)
        step = max(step, 3.0 * _between_runs(found, name, limits) / deviation)
    limits = limits.each_times(max(step / limits.step, 1.0), max(drift / limits.drift, 1.0), 1.0)
    least_growth = growth * max(limits.usual_growth, 1.0)
    return limits.model_copy(
        update={
            "drift": None if name == "speed" else limits.drift,
            "growth": max(limits.growth or 0.0, least_growth),
        }
    )


def _level(found: Healthy, row: int, probability: float) -> float:
    seen = found.peaks(row)
    tail = Tail.fit(seen, probability)
    beyond = probability * len(seen) < 1.0
    return max(tail.safe_level(probability) if beyond else tail.level(probability), LEAST_LIMIT / FAR)


def _score(maxima: Array, factors: Array) -> Array:
    """(windows, fans) the statistic furthest towards its limit, with limits so many times as far."""
    return (maxima[:, :STATISTICS] / factors[:, np.newaxis]).max(axis=1)


def survey(runs: Runs, limits: Limits, top_speed_rad_s: float) -> Healthy:
    """Judge healthy runs by some limits and keep what calibration needs."""
    healthy = Healthy(top_speed_rad_s)
    for fans, blocks in runs():
        judge = Judge(fans, limits)
        judge.watch()
        windows = Windows(fans, limits.timing.on_delay_s)
        for block in blocks:
            _take(healthy, judge, windows, block)
        healthy.maxima.append(windows.end())
        for name in RESIDUALS:
            baseline = getattr(judge, name).baseline
            healthy.moments[name].baselines.append(baseline.commissioned[baseline.is_set])
    return healthy


def _take(healthy: Healthy, judge: Judge, windows: Windows, block: Samples) -> None:
    verdict = judge.update(block)
    judged = np.isfinite(verdict.score)
    ratios = judge.watched()
    windows.add(block.t_ns, block.step_ns, ratios, judged)
    healthy.step_s = block.step_ns / 1e9
    healthy.fan_s += float(judged.sum()) * healthy.step_s
    healthy.stuck_s = max(healthy.stuck_s, judge.sensor.longest_s)
    healthy.missing = max(healthy.missing, judge.sensor.most_missing)
    bins = np.clip(np.abs(block.speed_rad_s) / healthy.top_speed_rad_s * SPEED_BINS, 0, SPEED_BINS - 1)
    for name, residual, valid, smoothed, baseline, growth in (
        ("speed", block.speed_residual, block.speed_valid, verdict.speed_smoothed, verdict.speed_baseline, ratios[2]),
        ("balance", block.balance, block.balance_valid, verdict.balance_smoothed, verdict.balance_baseline, ratios[5]),
    ):
        use = valid & np.isfinite(smoothed)
        if use.any():
            healthy.moments[name].growth += float(growth[use].sum())
            shift = np.clip(np.where(use, residual - baseline, np.nan), -WILD, WILD)
            _note(healthy.moments[name], shift, bins, healthy.step_s)


def _note(moments: _Moments, shift: Array, bins: Array, step_s: float) -> None:
    use = np.isfinite(shift)
    where = bins[use].astype(int)
    moments.count += np.bincount(where, minlength=SPEED_BINS)
    moments.total += np.bincount(where, shift[use], minlength=SPEED_BINS)
    moments.square += np.bincount(where, shift[use] ** 2, minlength=SPEED_BINS)
    second = max(1, round(1.0 / step_s))
    whole = len(shift) // second * second
    if whole:
        means = shift[:whole].reshape(-1, second, shift.shape[1]).mean(axis=1)
        means = means[np.isfinite(means)]
        moments.means += means.size
        moments.mean_square += float((means**2).sum())


def _open(limits: ResidualLimits) -> ResidualLimits:
    return limits.model_copy(
        update={"step": FAR, "drift": FAR, "growth": FAR, "baseline_sigmas": FAR, "adaptation_sigmas": FAR}
    )


def _shape(found: Healthy, name: str) -> ResidualLimits:
    """How the healthy residual varies: over speeds, in time, and from run to run."""
    moments = found.moments[name]
    if not moments.count.sum():
        return ResidualLimits(baseline_sigmas=FAR, adaptation_sigmas=FAR)
    speeds, offsets, spreads = _over_speeds(moments, found)
    deviation = math.sqrt(max(moments.square.sum() / moments.count.sum(), 1e-12))
    of_means = math.sqrt(moments.mean_square / moments.means) / deviation if moments.means else 0.0
    return _open(
        ResidualLimits(
            speeds_rad_s=speeds,
            offset_sigmas=offsets,
            spread=spreads,
            autocorrelation_time_s=_memory_s(of_means**2, found.step_s),
        )
    ).model_copy(update={"baseline_sigmas": _farthest(np.concatenate(moments.baselines))})


def _farthest(baselines: Array) -> float:
    """How far the baseline of one more healthy run may be from none: a prediction interval, by Student's t."""
    few = len(baselines)
    largest = BASELINE_MARGIN * float(np.abs(baselines).max())
    if few < LEAST_BASELINES:
        return max(2.0 * largest, FEW_BASELINES)
    reach = float(t.ppf(0.5 + BASELINE_COVERAGE / 2, few - 1) * baselines.std(ddof=1) * math.sqrt(1.0 + 1.0 / few))
    return max(largest, abs(float(baselines.mean())) + reach, 1.0)


def _over_speeds(moments: _Moments, found: Healthy) -> tuple[tuple[float, ...], tuple[float, ...], tuple[float, ...]]:
    """Knots, means and standard deviations, each of enough healthy running; one knot where there is little."""
    centre = (np.arange(SPEED_BINS) + 0.5) / SPEED_BINS * found.top_speed_rad_s
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


def _limit(
    limits: ResidualLimits, name: str, found: Healthy, timing: Timing, each: float, drifts_too: bool
) -> ResidualLimits:
    if limits.step is None:
        return limits
    first = FIRST[RESIDUALS.index(name)]
    now = (limits.step, limits.drift or FAR, limits.growth or FAR)
    step, drift, growth = (_level(found, first + k, each) * now[k] for k in range(3))
    deviation = smoothed_deviation(timing.smoothing_s, limits.autocorrelation_time_s, found.step_s)
    if not drifts_too:
        reference = max(SHARE_OF_STEP * step * deviation, SHARE_OF_STEP, _between_runs(found, name, limits))
        return limits.model_copy(
            update={
                "step": step,
                "reference_sigmas": reference,
                "adaptation_sigmas": step * deviation * limits.mean_spread,
            }
        )
    moments = found.moments[name]
    usual = float(moments.growth / max(moments.count.sum(), 1.0)) * now[2]
    return limits.model_copy(
        update={"drift": drift, "usual_growth": usual, "growth": max(growth, (1.0 + LEAST_GROWTH) * usual)}
    )


def _between_runs(found: Healthy, name: str, limits: ResidualLimits) -> float:
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


def _interval(found: Healthy, factors: Array, seed: int) -> tuple[float, float]:
    """95 % of the alarms per fan and day by limits that are so many times as far, (7,)."""
    window_days = found.fan_s / found.windows / DAY_S
    raised = [peaks(_score(run, factors)) > 1.0 for run in found.maxima]
    judged = [np.isfinite(run[:, SCORE]) for run in found.maxima]
    parts = list(zip(raised, judged, strict=True))
    if len(parts) < ENOUGH_BLOCKS:
        parts = [(alarms.T[k], seen.T[k]) for alarms, seen in parts for k in range(alarms.shape[1])]
    if len(parts) < ENOUGH_BLOCKS:
        parts = [
            (alarms[k : k + WINDOWS_OF_BLOCK], seen[k : k + WINDOWS_OF_BLOCK])
            for alarms, seen in parts
            for k in range(0, len(alarms), WINDOWS_OF_BLOCK)
        ]
    parts = [(alarms, seen) for alarms, seen in parts if seen.any()]
    counts = np.array([alarms.sum() for alarms, _ in parts], np.float64)
    days = np.array([seen.sum() for _, seen in parts]) * window_days
    return rate_interval(counts, days, seed)
