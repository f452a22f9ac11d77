"""What the fans of each of several trays share, while these trays are scored in one pass.

Each tray goes on by itself, to the bit: see scoring.baseline.shared_offset. Only their sums are taken together, and the
ends of intervals in which nothing but the offset moves.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from schemas.messages import Array
from scoring.baseline.intervals import Intervals
from scoring.baseline.shared_offset import (
    FIXED_POINT_ONE,
    LEAST_FANS,
    MIN_VALID_SHARE,
    SharedOffset,
    SharedOverIntervals,
    middle_offsets,
    sums,
)


class JointSharedOffset:
    """The offsets of trays with as many fans each, of one residual. All arrays (..., fans) have the fans of all trays,
    one tray after the other. Each tray has a commissioned fan.
    """

    is_known = True

    def __init__(self, of_trays: Sequence[SharedOffset]) -> None:
        self._of_trays = of_trays
        self._fans = len(of_trays[0].counts)

    @property
    def independent_intervals(self) -> float:
        """See SharedOffset: of each tray."""
        return self._of_trays[0].independent_intervals

    def over(
        self,
        offset: Array,
        speed_sigmas: Array,
        valid: Array,
        intervals: Intervals,
        _commissioned: Array,
        _moving: Array | None,
    ) -> SharedOverIntervals:
        """What is shared in the present interval, see SharedOffset.over; all samples are in this interval."""
        products, squares, counts = sums(offset, speed_sigmas, valid, intervals)
        for column, name in ((products, "products"), (squares, "squares"), (counts, "counts")):
            column[0] += np.concatenate([getattr(each, name) for each in self._of_trays])
        values = np.repeat(np.concatenate([each.value for each in self._of_trays]), self._fans)
        return SharedOverIntervals(values[np.newaxis], np.zeros((1, 0)), products, squares, counts, 1)

    def take(self, of: SharedOverIntervals) -> None:
        """See SharedOffset.take: the interval goes on, so only the sums have changed."""
        for each, fans in self._each():
            each.products[:], each.squares[:], each.counts[:] = (
                column[-1, fans] for column in (of.products, of.squares, of.counts)
            )

    def end_interval(self, samples: int, commissioned: Array, learns: Array, moving: Array, *, at_first: bool) -> Array:
        """See SharedOffset.end_interval."""
        assert not at_first
        alone = np.zeros(len(commissioned), np.bool_)
        products, squares, counts = (
            np.array([getattr(each, name) for each in self._of_trays]) for name in ("products", "squares", "counts")
        )
        known = (counts >= MIN_VALID_SHARE * samples) & (squares > 0) & ~moving.reshape(counts.shape)
        is_compared = known.sum(axis=1) >= LEAST_FANS
        first = self._of_trays[0]
        at_commissioning = np.array([each.commissioned for each in self._of_trays])
        ridge = first.ridge * FIXED_POINT_ONE * counts
        fast = first.fast(known, squares, counts)
        low, high = middle_offsets(fast, products, squares, ridge, at_commissioning)
        value = np.concatenate([each.value for each in self._of_trays])
        value = value + first.gain * (np.minimum(np.maximum(value, low), high) - value)
        least, most = at_commissioning[:, 0] - first.limit, at_commissioning[:, 0] + first.limit
        moved = np.minimum(np.maximum(value, least), most).tolist()
        for number, (each, fans) in enumerate(self._each()):
            if is_compared[number] and not each.is_becoming_known(each.now):
                each.value[:] = each.compared[:] = moved[number]
                each.products[:] = each.squares[:] = each.counts[:] = 0
            else:
                alone[fans] = each.end_interval(samples, commissioned[fans], learns[fans], moving[fans], at_first=False)
        return alone

    def _each(self) -> Sequence[tuple[SharedOffset, slice]]:
        """Each tray, and its fans."""
        return [(each, slice(k * self._fans, (k + 1) * self._fans)) for k, each in enumerate(self._of_trays)]
