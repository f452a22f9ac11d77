"""Reports fans that have not been scored for too long: they can raise no alarm."""

from __future__ import annotations

import numpy as np

from fantwin.schemas.enums import InvalidReason
from fantwin.schemas.fan_names import NO_NAMES, FanNames
from fantwin.schemas.messages import Array
from fantwin.schemas.units import NS_PER_S
from fantwin.scoring.samples import IDLE, among

FIRST_WARM_UP_NS = 60 * NS_PER_S  # a fan that was never scored may warm up for this long before it is reported
REASONS = {
    InvalidReason.NONE: "no reason given",
    InvalidReason.STALE: "the line is silent",
    InvalidReason.GAP: "samples are missing",
    InvalidReason.WARMING_UP: "the twin is warming up",
    InvalidReason.OUT_OF_RANGE: "the command is outside the twin's range, or a value is not a number",
    InvalidReason.NO_SPEED: "no speed",
    InvalidReason.NO_TWIN: "there is no twin yet, or it does not fit the grid's rate",
    InvalidReason.CLOCK_RESTARTED: "the clock of the device restarted",
    InvalidReason.STOPPED: "stopped by its command",
    InvalidReason.STARTING: "starting",
    InvalidReason.CONDITIONS_UNKNOWN: "a supply voltage or temperature that the twin needs is not known",
}
JUDGED_AT_REST = (InvalidReason.STOPPED, InvalidReason.STARTING)
"""a fan without a score for one of these reasons is judged by whether it stands or turns as commanded"""


RARE_WINDOWS = 2
"""a fan is reported after this many windows in which it was scored, but for less than half of the time. One is not
enough: the end of a long time without a score gives one"""


class UnscoredMonitor:
    """Time for which each fan has not been scored, in the time of its samples, and the reason.

    A fan that is scored only now and then can hardly raise an alarm either. Its scored time is counted in windows of
    `limit_ns`.
    """

    def __init__(self, fans: int, limit_ns: int, names: FanNames = NO_NAMES) -> None:
        self._limit_ns, self._names = limit_ns, names
        self._unscored_ns = np.zeros(fans, np.int64)
        self._invalid_reason = np.zeros(fans, np.uint8)
        self._was_scored = np.zeros(fans, np.bool_)
        self._window_ns, self._scored_ns = 0, np.zeros(fans, np.int64)
        """length of the window so far, and (fans,) the time of it in which each was scored"""
        self._rare_windows = np.zeros(fans, np.int64)
        """number of windows in which a fan was scored rarely, since the last one in which it was scored for half of the
        time"""
        self._latest_reason = np.zeros(fans, np.uint8)
        """reason of the last sample that was not scored, by fan"""

    def update(self, period_ns: int, valid: Array, invalid_reason: Array) -> None:
        """Process a block; valid, invalid_reason: (n, fans)."""
        judged = valid | among(invalid_reason, *IDLE)
        scored = judged.any(axis=0)
        rows_since = np.where(scored, np.argmax(judged[::-1], axis=0), len(valid))
        self._unscored_ns = np.where(scored, 0, self._unscored_ns) + rows_since * period_ns
        self._invalid_reason = invalid_reason[-1]
        self._was_scored |= scored
        last = len(judged) - 1 - np.argmax(~judged[::-1], axis=0)
        latest = np.take_along_axis(invalid_reason, last[np.newaxis], axis=0)[0]
        self._latest_reason = np.where(judged.all(axis=0), self._latest_reason, latest)
        self._count_shares(period_ns, judged)

    def _count_shares(self, period_ns: int, judged: Array) -> None:
        """Count the scored time in windows. They end at the same samples, whatever the blocks."""
        while len(judged):
            rows = min(len(judged), -(-(self._limit_ns - self._window_ns) // period_ns))
            self._window_ns += rows * period_ns
            self._scored_ns += np.count_nonzero(judged[:rows], axis=0) * period_ns
            judged = judged[rows:]
            if self._window_ns >= self._limit_ns:
                is_enough = 2 * self._scored_ns >= self._window_ns
                self._rare_windows = np.where(is_enough, 0, self._rare_windows + (self._scored_ns > 0))
                self._window_ns, self._scored_ns[:] = 0, 0

    def problem(self) -> str:
        """Line on the fans that are not scored; empty for none. Times double, so that the line rarely changes."""
        first_warm_up = ~self._was_scored & (self._invalid_reason == int(InvalidReason.WARMING_UP))
        limit_ns = np.where(first_warm_up, max(self._limit_ns, FIRST_WARM_UP_NS), self._limit_ns)
        late = self._unscored_ns >= limit_ns
        parts = []
        for reason in np.unique(self._invalid_reason[late]).tolist():
            fans = np.flatnonzero(late & (self._invalid_reason == reason))
            doublings = int(self._unscored_ns[fans].min() // self._limit_ns).bit_length() - 1
            at_least_s = self._limit_ns * 2**doublings / NS_PER_S
            parts.append(f"{self._subject(fans)} not scored: {_explanation(reason)}, for {at_least_s:g} s or more")
        rarely = ~late & (self._rare_windows >= RARE_WINDOWS)
        for reason in np.unique(self._latest_reason[rarely]).tolist():
            fans = np.flatnonzero(rarely & (self._latest_reason == reason))
            parts.append(f"{self._subject(fans)} not scored most of the time: {_explanation(reason)}")
        return "; ".join(parts)

    def _subject(self, fans: Array) -> str:
        return f"{self._names.labels(fans.tolist())} {'is' if len(fans) == 1 else 'are'}"


def _explanation(reason: int) -> str:
    return REASONS.get(InvalidReason(reason), InvalidReason(reason).words)
