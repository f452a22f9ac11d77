"""Durations for which conditions have held."""

from __future__ import annotations

import numpy as np

from fantwin.schemas.messages import Array


class Durations:
    """Durations over blocks of samples, each of which lasts one period. Samples that are not valid change nothing."""

    def __init__(self, valid: Array, period_ns: int) -> None:
        self.valid = valid
        self.period_ns = period_ns

    def of(self, grows: Array, ends: Array, before_ns: Array) -> Array:
        """Durations, ns, (..., n, fans): they grow with samples of `grows` and begin again with those of `ends`, both
        as many.

        before_ns: (..., fans) after the last block, and after this one when it returns.
        """
        grown: Array = (grows & self.valid).cumsum(axis=-2) * self.period_ns
        ended = ends & self.valid
        at_end = np.maximum.accumulate(np.where(ended, grown, 0), axis=-2)
        has_ended = np.logical_or.accumulate(ended, axis=-2)
        duration = grown - at_end + np.where(has_ended, 0, before_ns[..., np.newaxis, :])
        before_ns[:] = duration[..., -1, :]
        return duration
