"""Fans that are not judged: no alarm can come of them, so somebody must be told."""

from __future__ import annotations

import numpy as np

from schemas.messages import Array, InvalidReason
from schemas.units import NS_PER_S

FIRST_WARM_UP_NS = 60 * NS_PER_S  # a fan that was never judged may warm up for so long before that is told
IN_WORDS = {
    InvalidReason.NONE: "no reason given",
    InvalidReason.STALE: "the line is silent",
    InvalidReason.GAP: "samples are missing",
    InvalidReason.WARMING_UP: "the twin is warming up",
    InvalidReason.OUT_OF_RANGE: "the command is out of the twin's range, or a value is no number",
    InvalidReason.SATURATED: "saturated",
    InvalidReason.NO_SPEED: "no speed",
    InvalidReason.NO_TWIN: "the twin does not fit the grid's rate",
}


class UnscoredMonitor:
    """For how long each fan has not been judged, in the time of its samples, and why."""

    def __init__(self, fans: int, limit_ns: int) -> None:
        self._limit_ns = limit_ns
        self._lasted_ns = np.zeros(fans, np.int64)
        self._why_not = np.zeros(fans, np.uint8)
        self._was_judged = np.zeros(fans, np.bool_)

    def update(self, period_ns: int, valid: Array, invalid_reason: Array) -> None:
        """Take a block, (n, fans) each."""
        judged = valid.any(axis=0)
        since = np.where(judged, np.argmax(valid[::-1], axis=0), len(valid))
        self._lasted_ns = np.where(judged, 0, self._lasted_ns) + since * period_ns
        self._why_not = invalid_reason[-1]
        self._was_judged |= judged

    def problem(self) -> str:
        """Which fans are not judged; times only as multiples, so that the line does not change all the time."""
        first_warm_up = ~self._was_judged & (self._why_not == InvalidReason.WARMING_UP)
        limit_ns = np.where(first_warm_up, max(self._limit_ns, FIRST_WARM_UP_NS), self._limit_ns)
        late = self._lasted_ns >= limit_ns
        parts = []
        for why in np.unique(self._why_not[late]).tolist():
            fans = np.flatnonzero(late & (self._why_not == why))
            doubled = int(self._lasted_ns[fans].min() // self._limit_ns).bit_length() - 1
            names = ", ".join(map(str, fans.tolist()))
            who = f"fan {names} is" if len(fans) == 1 else f"fans {names} are"
            lasted_s = self._limit_ns * 2**doubled / NS_PER_S
            reason = InvalidReason(why)
            words = IN_WORDS.get(reason, reason.words)
            parts.append(f"{who} not judged: {words} for {lasted_s:g} s and more")
        return "; ".join(parts)
