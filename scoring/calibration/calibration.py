"""Limits from healthy running, such that alarms come as rarely as declared.

A healthy recording is judged as a live fan is: commissioned at its start, baselines followed, statistics run. Of every
window of ten seconds the highest value is kept that each statistic held for the on-delay. Limits are where these are
equally rare for every statistic, and so rare that the whole, which is an alarm, comes as often as declared: how much
oftener than one statistic alone is counted at lower limits. An excursion over several windows is one alarm. Where a
limit lies beyond all that was seen it is put at the safe end of what the tail says. The interval of the rate is by the
alarms that these limits would have raised, see scoring.calibration.alarm_rate: blocks are whole runs where there are
enough of
them, fans of runs or minutes where not.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from schemas.messages import Array
from scoring.baseline.fan_offsets import fan_offsets
from scoring.calibration.alarm_rate import rate_interval
from scoring.calibration.healthy_statistics import FIRST, RESIDUALS, Healthy, Runs, survey, truncate_runs
from scoring.calibration.healthy_variation import FAR, between_runs, followed, lasting, open_limits, shape
from scoring.calibration.tail import Tail
from scoring.calibration.windows import peaks
from scoring.limits import DeclaredRate, Limits, ResidualLimits, Timing, smoothed_deviation

DAY_S = 86_400.0
NEEDED_ALARMS = 3.0  # false alarms expected in the healthy data, for their rate to be told from other rates
SHAPE_FAN_S = 5 * DAY_S  # of healthy running are enough to know how residuals vary; how rarely they go far takes all
ENOUGH_BLOCKS = 8
LEAST_WINDOWS = 6
WINDOWS_OF_BLOCK = 6  # a minute
MOST_LIKELY = 0.25  # a window with an alarm may not be likelier: the limits would be within the noise
LEAST_LIMIT = 0.1
LEAST = (4.0, 2.0, 2.5)  # limits of step, drift and growth: what is nearer is within every healthy fan's reach
LEAST_GROWTH = 0.01
STUCK_MARGIN, LEAST_STUCK_S = 3.0, 2.0
MISSING_MARGIN, LEAST_MISSING, MOST_MISSING = 3.0, 0.25, 0.9
SHARE_OF_STEP = 0.25  # the CUSUM's reference value, of the limit of the step
USUAL = 0.999  # of the seconds: what lasts for one of them, and no longer, is no drift
STATISTICS = 7
SEEN_WINDOWS = 50.0  # with an alarm, to count how often statistics alarm together
SENSOR, SCORE = 6, 7  # after the statistics of both residuals
ROUNDING = 1e-9


class TooLittleError(Exception):
    """The healthy running cannot support what is to be declared."""

    def __init__(self, fan_hours: float, needed_fan_hours: float, least_per_day: float) -> None:
        super().__init__(fan_hours, needed_fan_hours)
        self.fan_hours = fan_hours
        self.needed_fan_hours = needed_fan_hours
        self.least_per_day = least_per_day
        """the lowest rate that can be declared with what is there"""


def calibrate(
    runs: Runs,
    top_speed_rad_s: float,
    timing: Timing,
    false_alarms_per_day: float,
    seed: int = 0,
    extrapolate: bool = False,
    bend_rad_s: float | None = None,
) -> Limits:
    """Limits with a declared number of false alarms per fan and day.

    bend_rad_s: viscous / (2 drag) of the fans, see scoring.limits; None where it is not known.

    Raises:
        TooLittleError: the runs are too short for that, and extrapolate is not set; or too short for anything.
    """
    limits = Limits(speed=open_limits(ResidualLimits()), balance=open_limits(ResidualLimits()), timing=timing)
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
        }
    )
    limits = _shaped(runs, limits, found, each, bend_rad_s)
    found = survey(runs, limits, top_speed_rad_s)
    factors = _factors(found, target)
    for name, first in zip(RESIDUALS, FIRST, strict=True):
        scaled = getattr(limits, name).each_times(*factors[first : first + 3].tolist())
        if found.fan_s < needed_s:
            scaled = _cautious(scaled, name, found, timing)
        limits = limits.model_copy(update={name: scaled})
    promise = DeclaredRate(
        false_alarms_per_day=false_alarms_per_day,
        interval_95=_interval(found, factors, seed),
        extrapolated=found.fan_s < needed_s,
        fan_hours=found.fan_s / 3600,
        runs=len(found.maxima),
    )
    return limits.model_copy(update={"promise": promise})


def _shaped(runs: Runs, limits: Limits, found: Healthy, each: float, bend_rad_s: float | None) -> Limits:
    """How the residuals vary, and about how far each statistic then goes. found: by limits that nothing reaches."""
    top_speed_rad_s = found.top_speed_rad_s
    fans = {name: fan_offsets(found.moments[name].cells, found.centres_rad_s, found.step_s) for name in RESIDUALS}
    limits = _each(limits, lambda of, name: of.model_copy(update={"fans": fans[name]}))
    if found.fan_s > SHAPE_FAN_S or any(fans.values()):
        if found.fan_s > SHAPE_FAN_S:
            runs = truncate_runs(runs, len(found.maxima), SHAPE_FAN_S)
        found = survey(runs, limits, top_speed_rad_s)
    found, powers = followed(runs, limits, found, bend_rad_s)
    limits = _each(limits, lambda _, name: shape(found, name).model_copy(update=powers[name] | {"fans": fans[name]}))
    by_shape = survey(runs, limits, top_speed_rad_s)
    limits = _each(
        limits,
        lambda of, name: of.model_copy(update={"lasting": lasting(of, by_shape.moments[name], top_speed_rad_s)}),
    )
    timing = limits.timing
    now = survey(runs, limits, top_speed_rad_s)
    limits = _each(limits, lambda of, name: _with_step(of, name, now, timing, each))
    then = survey(runs, limits, top_speed_rad_s)  # the reference value of the drift follows from the limit of the step
    limits = _each(limits, lambda of, name: _with_drift_and_growth(of, name, then, each))
    return limits


def _each(limits: Limits, change: Callable[[ResidualLimits, str], ResidualLimits]) -> Limits:
    return limits.model_copy(update={name: change(getattr(limits, name), name) for name in RESIDUALS})


def _factors(found: Healthy, target: float) -> Array:
    """(7,) by how much to multiply the limit of each statistic, so that together they are passed so often."""
    often = min(max(target, SEEN_WINDOWS / found.windows), MOST_LIKELY)
    at = np.array([_level(found, row, often / STATISTICS) for row in range(STATISTICS)])
    together = np.concatenate([peaks(_score(run, at)).ravel() for run in found.maxima])
    passed = float((together[np.isfinite(together)] > 1.0).mean())
    alike = min(max(passed / (often / STATISTICS), 1.0), float(STATISTICS))  # as so many unrelated statistics
    factors = np.array([_level(found, row, target / alike) for row in range(STATISTICS)])
    factors[SENSOR] = 1.0  # its limits are not found by how rare they are
    return _no_oftener(found, factors, int(target * found.windows + ROUNDING))


def _no_oftener(found: Healthy, factors: Array, allowed: int) -> Array:
    """The same, but that these runs have no more alarms than that: a tail by many fans says little of the worst one.

    What raises most alarms has to go further, by a few of its excursions at a time.
    """
    factors = factors.copy()
    while True:
        too_many = sum(int((peaks(_score(run, factors)) > 1.0).sum()) for run in found.maxima) - allowed
        each = [
            np.concatenate([peaks(run[:, row] / factors[row]).ravel() for run in found.maxima]) for row in range(SENSOR)
        ]
        beyond = [np.sort(of[of > 1.0]) for of in each]
        most = max(range(SENSOR), key=lambda row: len(beyond[row]))
        if too_many <= 0 or not len(beyond[most]):
            return factors
        at_once = min(max(too_many // STATISTICS, 1), len(beyond[most]))
        factors[most] *= beyond[most][at_once - 1] * (1.0 + ROUNDING)


def _cautious(limits: ResidualLimits, name: str, found: Healthy, timing: Timing) -> ResidualLimits:
    """Limits where the running is too little to set them: none nearer than `LEAST`.

    A day's own friction moves the balance alike at every speed, but not the speed. Without enough running to know how,
    and unless offsets are seen to go with the speed, a fan that goes to another speed may be as far off as other
    healthy runs are: the speed's step is judged from there on, and its drift not at all.
    """
    if limits.step is None or limits.drift is None or limits.growth is None:
        return limits
    step, drift, growth = LEAST
    if name == "speed" and limits.baseline_power == 0:
        deviation = smoothed_deviation(timing.smoothing_s, limits.autocorrelation_time_s, found.step_s)
        step = max(step, 3.0 * between_runs(found, name, limits) / deviation)
    limits = limits.each_times(max(step / limits.step, 1.0), max(drift / limits.drift, 1.0), 1.0)
    least_growth = growth * max(limits.usual_growth, 1.0)
    return limits.model_copy(
        update={
            "drift": None if name == "speed" and limits.baseline_power == 0 else limits.drift,
            "growth": max(limits.growth or 0.0, least_growth),
        }
    )


def _level(found: Healthy, row: int, probability: float) -> float:
    seen = found.peaks(row)
    tail = Tail.fit(seen, probability)
    beyond = probability * len(seen) < 1.0
    return max(tail.upper_confidence_level(probability) if beyond else tail.level(probability), LEAST_LIMIT / FAR)


def _score(maxima: Array, factors: Array) -> Array:
    """(windows, fans) the statistic furthest towards its limit, with limits so many times as far."""
    return (maxima[:, :STATISTICS] / factors[:, np.newaxis]).max(axis=1)


def _with_step(limits: ResidualLimits, name: str, found: Healthy, timing: Timing, each: float) -> ResidualLimits:
    if limits.step is None:
        return limits
    step = _level(found, FIRST[RESIDUALS.index(name)], each) * limits.step
    deviation = smoothed_deviation(timing.smoothing_s, limits.autocorrelation_time_s, found.step_s)
    least = max(SHARE_OF_STEP, between_runs(found, name, limits))
    return limits.model_copy(
        update={
            "step": step,
            "reference_sigmas": max(SHARE_OF_STEP * step * deviation, found.moments[name].lasts(USUAL), least),
            "adaptation_sigmas": step * deviation * limits.mean_spread,
        }
    )


def _with_drift_and_growth(limits: ResidualLimits, name: str, found: Healthy, each: float) -> ResidualLimits:
    if limits.drift is None or limits.growth is None:
        return limits
    first, moments = FIRST[RESIDUALS.index(name)], found.moments[name]
    usual = float(moments.growth / max(moments.count.sum(), 1.0)) * limits.growth
    growth = _level(found, first + 2, each) * limits.growth
    return limits.model_copy(
        update={
            "drift": _level(found, first + 1, each) * limits.drift,
            "usual_growth": usual,
            "growth": max(growth, (1.0 + LEAST_GROWTH) * usual),
        }
    )


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
