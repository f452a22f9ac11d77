"""Times that go back: a counter that wraps goes on, a damaged row costs itself, a clock that was set is said.

For tables and logs alike: the order of rows is the order in which they were written.
"""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path

import numpy as np

from fantwin.pipeline.errors import UserError
from fantwin.pipeline.sources.column_file import listed
from fantwin.schemas.messages import Array
from fantwin.schemas.units import NS_PER_S

OUT_OF_ORDER_NS = NS_PER_S
"""rows up to this much late are sorted; more means a counter that wrapped, damage, or a clock that was set"""
_WRAPS_NS = {
    "32 bits of microseconds": (1 << 32) * 1_000,
    "32 bits of milliseconds": (1 << 32) * 1_000_000,
    "16 bits of milliseconds": (1 << 16) * 1_000_000,
    "24 hours": 86_400 * NS_PER_S,
}
_USUAL_STEPS = 20.0
"""across a wrap, the step is no longer than so many usual ones, or a second"""
_STEPS_OF_NEIGHBOURS = 5.0
"""rows that follow one another in no more than so many usual steps belong together"""
_MOST_DAMAGED = 0.05
"""share of rows whose times may be damaged; more mean another cause"""
_AHEAD_OF = 5
"""rows that one may be ahead of, as if they were late; ahead of more, it is the one that is damaged"""
_HOUR_NS = 3600 * NS_PER_S
_YEAR_NS = 365 * 86_400 * NS_PER_S


class SetBackError(UserError):
    """Times go back as if a clock had been set, or as in rows of several series: one line that says what was seen."""


@dataclass(frozen=True)
class Clock:
    """Times that go on.

    Attributes:
        t_ns: (rows,) as they were, with what a counter lost at its wraps added.
        is_good: (rows,) False where a time is damaged.
        notes: what was seen, a line each.
    """

    t_ns: Array
    is_good: Array
    notes: tuple[str, ...] = ()


def continued(path: Path, t_ns: Array, has_time: Array, *, longest_part: bool = False) -> Clock:
    """Times in the order of rows, without wraps and damage. has_time: (rows of the file,) which of them these are.

    longest_part: where the clock was set back, the longest part is good and the rest is not, as nobody can cut a log.

    Raises:
        SetBackError: the clock was set back.
    """
    is_good = np.ones(len(t_ns), np.bool_)
    if not goes_back(t_ns):
        return Clock(t_ns, is_good)
    t_ns, notes = _unwrapped(t_ns)
    if not goes_back(t_ns):
        return Clock(t_ns, is_good, tuple(notes))
    rows = np.flatnonzero(has_time)
    damaged = _damaged(t_ns)
    if len(damaged):
        is_good[damaged] = False
        shown = listed([str(int(rows[k]) + 1) for k in damaged])
        row = "row" if len(damaged) == 1 else "rows"
        notes.append(f"{len(damaged)} {row} dropped: the time contradicts the rows around ({row} {shown})")
    good = np.flatnonzero(is_good)
    behind = np.maximum.accumulate(t_ns[good]) - t_ns[good]
    back = np.flatnonzero(behind > OUT_OF_ORDER_NS)
    if len(back):
        if not longest_part:
            raise SetBackError(f"{path}: {_set_back_in_words(t_ns[good], rows[good], int(back[0]))}")
        part = _longest_part(t_ns[good])
        left_out = len(good) - (part.stop - part.start)
        is_good[:] = False
        is_good[good[part]] = True
        words = _set_back_in_words(t_ns[good], rows[good], int(back[0])).partition(":")[0]
        notes.append(f"{words}: the longest part is read, {left_out} rows are left out")
    return Clock(t_ns, is_good, tuple(notes))


def goes_back(t_ns: Array) -> bool:
    """Whether some time is before the one in the row above."""
    return bool(np.any(t_ns[1:] < t_ns[:-1]))


def _usual_step_ns(t_ns: Array) -> float:
    steps = np.diff(t_ns)
    steps = steps[steps > 0]
    return float(np.median(steps)) if len(steps) else 0.0


def _unwrapped(t_ns: Array) -> tuple[Array, list[str]]:
    """Times with what a counter lost where it began again, and a note."""
    near = max(_USUAL_STEPS * _usual_step_ns(t_ns), 1.0)
    for title, period in _WRAPS_NS.items():
        if t_ns.min() < 0 or t_ns.max() >= period:
            continue
        steps = np.diff(t_ns)
        across = steps + period
        wraps = (steps < -period // 2) & (across >= 0) & (across <= min(max(near, NS_PER_S), period // 4))
        if wraps.any():
            lost = np.concatenate([[0], np.cumsum(wraps)]) * period
            count = int(np.count_nonzero(wraps))
            times = "once" if count == 1 else f"{count} times"
            return t_ns + lost, [f"the counter of the times wrapped {times} ({title}) and goes on"]
    return t_ns, []


def _damaged(t_ns: Array) -> Array:
    """The rows without which times go on: those outside the longest series that never goes back.

    None where they are not alone: rows that follow one another as usual are no damage, but a clock that was set.
    """
    late = np.maximum.accumulate(t_ns) - t_ns
    ahead = t_ns - np.minimum.accumulate(t_ns[::-1])[::-1]
    first, last = int(np.argmax(ahead > 0)), len(t_ns) - int(np.argmax(late[::-1] > 0))
    part = t_ns[first:last]
    kept = _never_back(part)
    outside = np.ones(len(part), np.bool_)
    outside[kept] = False
    dropped = np.flatnonzero(outside) + first
    usual = _usual_step_ns(t_ns)
    of_order = np.count_nonzero(late > 0)
    is_damage = np.maximum(ahead[dropped], late[dropped]) > OUT_OF_ORDER_NS
    dropped = dropped[is_damage | (of_order > _AHEAD_OF * len(dropped))]
    if not len(dropped) or len(dropped) > max(1, _MOST_DAMAGED * len(t_ns)):
        return dropped[:0]
    far = _STEPS_OF_NEIGHBOURS * max(usual, 1.0)
    for run in np.split(dropped, np.flatnonzero(np.diff(dropped) > 1) + 1):
        ends = [(run[0] - 1, run[0]), (run[-1], run[-1] + 1)]
        steps = [t_ns[b] - t_ns[a] for a, b in ends if a >= 0 and b < len(t_ns)]
        if len(run) > 1 and any(0 <= step <= far for step in steps):
            return dropped[:0]
    return dropped


def _never_back(t_ns: Array) -> Array:
    """Indices of the longest series of times that never goes back (Fredman 1975)."""
    ends: list[int] = []
    at: list[int] = []
    before = np.full(len(t_ns), -1, np.int64)
    for k, time in enumerate(t_ns.tolist()):
        place = bisect_right(ends, time)
        if place == len(ends):
            ends.append(time)
            at.append(k)
        else:
            ends[place], at[place] = time, k
        before[k] = at[place - 1] if place else -1
    series: list[int] = []
    k = at[-1]
    while k >= 0:
        series.append(k)
        k = int(before[k])
    return np.array(series[::-1], np.int64)


def _longest_part(t_ns: Array) -> slice:
    """The longest stretch of rows in which no time goes back by more than rows may be late."""
    cuts = [0, *(np.flatnonzero(np.diff(t_ns) < -OUT_OF_ORDER_NS) + 1).tolist(), len(t_ns)]
    return max((slice(a, b) for a, b in pairwise(cuts)), key=lambda part: part.stop - part.start)


def _set_back_in_words(t_ns: Array, rows: Array, at: int) -> str:
    """What was seen where times go back, and what to do."""
    reached = int(t_ns[:at].max())
    by_ns = reached - int(t_ns[at])
    count = max(1, int(np.count_nonzero(np.diff(t_ns) < -OUT_OF_ORDER_NS)))
    often = "" if count == 1 else f", and {count - 1} times more"
    span = f"from {time_in_words(reached)} to {time_in_words(int(t_ns[at]))}"
    seen = f"time goes back by {by_ns / NS_PER_S:.3f} s at row {int(rows[at]) + 1}, {span}{often}"
    if abs(by_ns - _HOUR_NS) < 60 * NS_PER_S and is_date(reached):
        return f"{seen}: an hour that repeats when summer time ends; name the time zone, such as --zone Europe/Berlin"
    if count > 1:
        return f"{seen}: rows of several series or runs, or another column has the times: give each run a file"
    return f"{seen}: the clock was set, or a second run begins: cut the file there and import the parts"


def is_date(t_ns: int) -> bool:
    """Whether a time is since 1970, and not since a start."""
    return abs(t_ns) >= _YEAR_NS


def time_in_words(t_ns: int) -> str:
    """A time as a date, or in s where it is not since 1970."""
    if not is_date(t_ns):
        return f"{t_ns / NS_PER_S:.3f} s"
    return datetime.fromtimestamp(t_ns / NS_PER_S, UTC).strftime("%Y-%m-%d %H:%M:%S")
