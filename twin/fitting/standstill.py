"""How healthy fans stop, stand and start, from measured runs.

A command *turns* the fans if one turned under it, or under lower ones, for `STEADY_S`, and did not slow down. It
*stops* them if it, or higher ones, lasted `STOOD_S` and one came to rest under it; what follows the last increase of
the command before a start belongs to the start. Readings lag, so both times are extended by the reach of the tacho.

A reading of half of the lowest steady speed is taken for that of a fan that stands or comes to rest: a fan that loses
its power is then recognised before the last pulse, and a windmilling one is not called turning.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d, minimum_filter1d

from fantwin.schemas.standstill import SLOWED_SHARE, Standstill
from fantwin.twin.runs import Array, Run

STEADY_S = 5.0
STOOD_S = 10.0
AT_REST_S = 2.0  # a tacho of a fan that turns may read nothing for less
STEADY_SHARE = 0.8  # of the reading before: a fan that loses more slows down
LOWEST_SHARE_OF_TOP = 0.05  # a lower reading is of a fan at rest, whatever the lowest steady speed
STANDING_SHARE = 0.5  # of the lowest steady speed
LOWEST_QUANTILE = 0.001  # of steady readings: one odd reading does not set the lowest steady speed
MIN_LOG_FALL = 0.5  # a shorter coast says little about the time constant


@dataclass(frozen=True, eq=False)
class _FanSeries:
    """One fan in one stretch without gaps, at equal steps of time. speed_rad_s: sizes, NaN where missing."""

    period_s: float
    command: Array
    speed_rad_s: Array
    reach_s: float
    mean_delay_s: float

    def of_past(self, extreme: Callable[..., Array], seconds: float) -> Array:
        """(n,) the lowest or the highest command of the last seconds; NaN before so many have passed."""
        size = round((seconds + self.reach_s) / self.period_s) + 1
        found = extreme(self.command, size, origin=(size - 1) // 2)
        found[: size - 1] = np.nan
        return found


def find_standstill(runs: Sequence[Run]) -> Standstill | None:
    """What the runs show; None where they do not show at which commands fans turn, or drive them both ways."""
    series = [one for run in runs for one in _series(run)]
    top = max((float(np.nanmax(one.speed_rad_s, initial=0.0)) for one in series), default=0.0)
    if top <= 0.0 or any((one.command < 0.0).any() for one in series):
        return None
    at_rest_below = LOWEST_SHARE_OF_TOP * top
    rests = [rest for one in series for rest in _rests(one, at_rest_below)]
    stood, off = (max((rest[which] for rest in rests), default=-np.inf) for which in (0, 1))
    turning = _turning_command(series, at_rest_below, stood)
    if turning is None:
        return None
    driven = [one.of_past(minimum_filter1d, STEADY_S) >= turning for one in series]
    speeds = [
        one.speed_rad_s[its & (one.speed_rad_s >= at_rest_below)] for one, its in zip(series, driven, strict=True)
    ]
    lowest = float(np.quantile(np.concatenate(speeds), LOWEST_QUANTILE)) if any(map(len, speeds)) else 0.0
    standing_below = max(at_rest_below, STANDING_SHARE * lowest)
    turning = _turning_command(series, standing_below, stood)
    if turning is None:
        return None
    found = Standstill(
        turning_command=turning, standing_below_rad_s=standing_below, off_command=off if np.isfinite(off) else None
    )
    start_s = max((seconds for one in series for seconds in _starts(one, found)), default=None)
    coasts = [coast for one in series for coast in _coasts(one, found)]
    constants_s = [constant_s for _, constant_s, _, _ in coasts if constant_s > 0.0]
    from_top = float(np.log(top / standing_below))
    from_top_s = [seconds + constant_s * max(from_top - fall, 0.0) for seconds, constant_s, fall, _ in coasts]
    return found.model_copy(
        update={
            "start_s": start_s,
            "coast_s": max(from_top_s, default=None),
            "slowing_s": max((slowing_s for _, _, _, slowing_s in coasts), default=None),
            "coast_time_constant_s": float(np.median(constants_s)) if constants_s else None,
            "lapse_s": _longest_lapse_s(series, found, STEADY_S if start_s is None else start_s),
        }
    )


def _series(run: Run) -> Iterator[_FanSeries]:
    for stretch in run.split_at_gaps():
        period_s = stretch.median_period_s
        rows = np.searchsorted(stretch.t_s, np.arange(stretch.t_s[0], stretch.t_s[-1], period_s), side="right") - 1
        for fan, tacho in enumerate(stretch.tacho):
            command, speed = stretch.command[rows, fan], np.abs(stretch.speed_rad_s[rows, fan])
            yield _FanSeries(period_s, command, speed, tacho.reach_s, tacho.mean_delay_s)


def _turning_command(series: Sequence[_FanSeries], standing_below: float, above: float) -> float | None:
    """The lowest command that turns the fans, above one under which a fan stood."""
    found: list[float] = []
    for one in series:
        highest = one.of_past(maximum_filter1d, STEADY_S)
        ago = max(1, round(STEADY_S / 2 / one.period_s))
        before = np.concatenate((np.full(ago, np.nan), one.speed_rad_s))[: len(one.speed_rad_s)]
        steady = (one.speed_rad_s >= standing_below) & (one.speed_rad_s >= STEADY_SHARE * before)
        found += highest[steady & (highest > above)].tolist()
    return min(found, default=None)


def _rests(one: _FanSeries, at_rest_below: float) -> Iterator[tuple[float, float]]:
    """Of each rest the highest command under which the fan stood, and the highest that stops a fan, which is not above
    the command under which this one came to rest; minus infinity where it did not last.

    A fan that still slows down is not at rest: it may come to turn steadily. A few readings end no rest.
    """
    lowest = one.of_past(minimum_filter1d, STOOD_S)
    least, reach = (round(seconds / one.period_s) for seconds in (AT_REST_S + one.reach_s, one.reach_s))
    increases = np.flatnonzero(np.diff(one.command, prepend=one.command[:1]) > 0.0)
    stands = _last_known(one.speed_rad_s) < at_rest_below
    for first, last in _stretches(_without_glitches(stands, least, reach // 2 + 1)):  # one wrong reading
        end = last
        if last < len(one.command):  # it starts: from the last increase on
            before = increases[np.searchsorted(increases, last, side="right") - 1] if len(increases) else 0
            end = int(before) if first < before <= last else first
        # Of a fan that is at rest when a recording begins, it is not known what stopped it.
        came_under = one.command[max(first - reach, 0) : first + 1].max() if first else 0.0
        above = np.flatnonzero(one.command[first:end] > came_under)
        to = first + int(above[0]) if len(above) else end
        stood, stopping = (np.nanmax(lowest[first + least : until], initial=-np.inf) for until in (end, to))
        yield float(stood), float(stopping)


def _last_known(speed_rad_s: Array) -> Array:
    """The readings, with the last one in place of those that are missing; NaN before the first."""
    rows = np.maximum.accumulate(np.where(np.isfinite(speed_rad_s), np.arange(len(speed_rad_s)), -1))
    return np.where(rows >= 0, speed_rad_s[np.maximum(rows, 0)], np.nan)


def _without_glitches(stands: NDArray[np.bool_], least: int, longest: int) -> NDArray[np.bool_]:
    """The flags, true also where a fan that has stood for the least rows reads for no longer as if it turned."""
    filled, began = stands.copy(), 0
    for first, last in _stretches(~stands):
        if first - began >= least and last - first <= longest and last < len(stands):
            filled[first:last] = True
        else:
            began = last
    return filled


def _starts(one: _FanSeries, found: Standstill) -> Iterator[float]:
    """Times from a command to turn, given to a fan that stood, to the first reading of a fan that turns, s."""
    turns = found.turns(one.speed_rad_s)
    for first, last in _stretches(found.drives(one.command)):
        if first and one.speed_rad_s[first] < found.standing_below_rad_s and turns[first:last].any():
            yield float(turns[first:last].argmax()) * one.period_s


def _coasts(one: _FanSeries, found: Standstill) -> Iterator[tuple[float, float, float, float]]:
    """From each command to stop to the first reading of a fan that stands: its seconds, the time constant in s (0 where
    it is too short to show it), the logarithm of the fall of its readings, and the seconds until the reading is below
    `SLOWED_SHARE` of the highest one since the command, less the mean delay of readings.
    """
    stands = one.speed_rad_s < found.standing_below_rad_s
    for first, last in _stretches(found.stops(one.command, one.speed_rad_s)):
        if first and found.turns(one.speed_rad_s[first]) and stands[first:last].any():
            rows = int(stands[first:last].argmax())
            seconds = rows * one.period_s
            fall = float(np.log(one.speed_rad_s[first] / found.standing_below_rad_s))
            constant_s = max(seconds - one.mean_delay_s, 0.0) / fall if fall >= MIN_LOG_FALL else 0.0
            readings = np.nan_to_num(one.speed_rad_s[first : first + rows + 1])
            slowed = np.flatnonzero(readings > SLOWED_SHARE * readings.max())[-1] + 1
            yield seconds, constant_s, fall, max(float(slowed) * one.period_s - one.mean_delay_s, 0.0)


def _longest_lapse_s(series: Sequence[_FanSeries], found: Standstill, start_s: float) -> float:
    longest = 0.0
    for one in series:
        turns = found.turns(one.speed_rad_s)
        for first, last in _stretches(found.drives(one.command)):
            started = first + round(start_s / one.period_s)
            rows = started + np.flatnonzero(turns[started:last])
            if len(rows):
                stands = one.speed_rad_s[rows[0] : rows[-1]] < found.standing_below_rad_s
                longest = max([longest, *((end - begin) * one.period_s for begin, end in _stretches(stands))])
    return longest


def _stretches(flags: NDArray[np.bool_]) -> Iterator[tuple[int, int]]:
    """First and one past the last row of each stretch of true flags."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], flags, [False]))))
    return zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True)
