"""Commands and speeds at grid times; speeds are interpolated linearly, each fan's between its own readings."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fantwin.schemas.channels import CHANNELS
from fantwin.schemas.messages import Array
from fantwin.schemas.units import NS_PER_S

NEVER_NS = -(1 << 62)
SLOW_NS = NS_PER_S // 2
"""a grid of this period or a longer one is slow: a fan moves much within it, so that the phase of samples and grid must
not show, which changes with a restart, and slips where a sample comes now before, now after a grid time"""
SETTLED_NS = 3 * NS_PER_S // 2
"""grid period from which on commands and readings are held until the next: in between, a fan reaches its speed"""
_IS_LINEAR = np.array([each.interpolation == "linear" for each in CHANNELS])[:, np.newaxis]


class Samples(NamedTuple):
    """Raw samples by strictly rising time. t_ns: (n,). command, speed_rad_s: (n, fans).

    auxiliary: (n, columns, fans), the columns of `CHANNELS`, NaN where a value is not known; (n, 0, fans) if the
    source measures nothing beside command and speed.
    """

    t_ns: Array
    command: Array
    speed_rad_s: Array
    auxiliary: Array

    def extended(self, later: Samples) -> Samples:
        """Return these samples followed by later ones."""
        before = self.auxiliary
        if before.shape[1] < later.auxiliary.shape[1]:
            before = np.full((len(self.t_ns), *later.auxiliary.shape[1:]), np.nan)
        return Samples(
            np.concatenate((self.t_ns, later.t_ns)),
            np.concatenate((self.command, later.command)),
            np.concatenate((self.speed_rad_s, later.speed_rad_s)),
            np.concatenate((before, later.auxiliary)),
        )

    def rows(self, wanted: slice | list[int]) -> Samples:
        """The samples in these rows."""
        return Samples(self.t_ns[wanted], self.command[wanted], self.speed_rad_s[wanted], self.auxiliary[wanted])


def all_true(mask: Array) -> bool:
    """Return mask.all(), a few times faster for small masks."""
    return np.count_nonzero(mask) == mask.size


def interpolate_samples(t_ns: Array, at: Array, samples: Samples, is_held: Array) -> Array:
    """Speeds (n, fans) at t_ns (n,), if every fan has a reading in every sample.

    at: (n,), index of the last sample at or before each time. is_held: (fans,) of bool, see LastReadings.
    """
    after = at + 1
    here_t_ns, here = samples.t_ns.take(at), samples.speed_rad_s.take(at, axis=0)
    since_ns = t_ns - here_t_ns
    span_ns = samples.t_ns.take(after, mode="clip") - here_t_ns
    share = np.where(is_held, 0.0, (since_ns / np.maximum(span_ns, 1))[:, np.newaxis])
    between = here + share * (samples.speed_rad_s.take(after, axis=0, mode="clip") - here)
    return np.where((since_ns == 0)[:, np.newaxis], here, between)


def held_commands(t_ns: Array, at: Array, samples: Samples, period_ns: int) -> Array:
    """Commands (n, fans) at t_ns (n,): those of the last samples at or before each time.

    On a slow grid on which fans do not settle, the mean of what holds until the next grid time, so that no impulse is
    lost: that command, and from its time on the one of the next sample. A grid sample is made when the first raw sample
    at or after it is there, so none after that counts.

    at: (n,), index of the last sample at or before each time.
    """
    held = samples.command.take(at, axis=0)
    if not SLOW_NS <= period_ns < SETTLED_NS:
        return held
    since_ns = t_ns + period_ns - samples.t_ns.take(at + 1, mode="clip")
    share = np.where(samples.t_ns.take(at) == t_ns, 0.0, (since_ns / period_ns).clip(0.0, 1.0))[:, np.newaxis]
    return np.where(share > 0.0, held + share * (samples.command.take(at + 1, axis=0, mode="clip") - held), held)


def interpolate_auxiliary(t_ns: Array, at: Array, samples: Samples) -> Array:
    """(n, columns, fans) values at t_ns (n,): linear between two samples that have one, else that of the one before.

    A channel that is held has the latter everywhere. at: (n,), index of the last sample at or before each time.
    """
    here_t_ns, here = samples.t_ns.take(at), samples.auxiliary.take(at, axis=0)
    after = samples.auxiliary.take(at + 1, axis=0, mode="clip")
    span_ns = samples.t_ns.take(at + 1, mode="clip") - here_t_ns
    share = ((t_ns - here_t_ns) / np.maximum(span_ns, 1))[:, np.newaxis, np.newaxis] * _IS_LINEAR
    between = here + share * (after - here)
    return np.where(np.isfinite(between), between, here)


class LastReadings:
    """The last reading of each fan before the samples that are still held."""

    def __init__(self, fans: int, limit_ns: int, is_held: Array) -> None:
        """is_held: (fans,) of bool, the tacho shows a reading until the next one: it is held, not interpolated."""
        self._limit_ns = limit_ns
        self._is_held = is_held
        self._fans = np.arange(fans)
        self._t_ns = np.full(fans, NEVER_NS, np.int64)
        self._speed_rad_s = np.full(fans, np.nan)

    def update(self, samples: Samples, count: int) -> None:
        """Take readings from the first `count` samples, which will no longer be held."""
        has = np.isfinite(samples.speed_rad_s[:count])
        last = count - 1
        if all_true(has[last]):
            self._t_ns, self._speed_rad_s = np.full(len(self._fans), samples.t_ns[last]), samples.speed_rad_s[last]
            return
        rows = last - has[::-1].argmax(axis=0)
        found = has[rows, self._fans]
        self._t_ns = np.where(found, samples.t_ns.take(rows), self._t_ns)
        self._speed_rad_s = np.where(found, samples.speed_rad_s[rows, self._fans], self._speed_rad_s)

    def too_old(self, t_ns: int) -> Array:
        """Return which fans (fans,) have no reading within the limit before t_ns."""
        return t_ns - self._t_ns > self._limit_ns

    def interpolate(self, t_ns: Array, at: Array, samples: Samples, newest_t_ns: int) -> tuple[Array, Array]:
        """Speeds (n, fans) at t_ns (n,) between each fan's own readings; NaN where one is missing or too far away.

        at: (n,), index of the last sample at or before each time. newest_t_ns: time of the newest sample received.
        The second array, (n, fans), is true where a fan's next reading may still arrive within the limit.
        """
        # Row 0 holds the last reading before these samples, so that every fan has a row before each time.
        fans = self._fans
        reading_t_ns = np.concatenate(
            (self._t_ns[np.newaxis], np.broadcast_to(samples.t_ns[:, np.newaxis], samples.speed_rad_s.shape))
        )
        speed = np.concatenate((self._speed_rad_s[np.newaxis], samples.speed_rad_s))
        rows, missing = np.arange(len(speed))[:, np.newaxis], len(speed)
        has = np.isfinite(speed)
        before = np.maximum.accumulate(np.where(has, rows, 0))[at + 1]
        following = np.minimum.accumulate(np.where(has, rows, missing)[::-1])[::-1]
        after = np.concatenate((following, np.full((1, len(fans)), missing)))[at + 2]
        none = after == missing
        after = np.where(none, before, after)
        here_t_ns, here = reading_t_ns[before, fans], speed[before, fans]
        since_ns = t_ns[:, np.newaxis] - here_t_ns
        span_ns = reading_t_ns[after, fans] - here_t_ns
        near = ~none & (span_ns <= self._limit_ns)
        share = np.where(self._is_held, 0.0, since_ns / np.where(near, span_ns, 1))
        between = here + share * (speed[after, fans] - here)
        found = np.where(since_ns == 0, here, np.where(near, between, np.nan))
        may_arrive = none & (since_ns > 0) & (newest_t_ns - here_t_ns <= self._limit_ns)
        return found, may_arrive
