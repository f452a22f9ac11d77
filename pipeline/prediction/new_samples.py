"""The new samples of an input: those that are newer than all before them.

A stage that restarts repeats what its producers have kept, and catches up at once. If the host clock was set back and
the stages before this one were restarted, its input remains older than what it has had: it is dropped as repeated, and
nothing is judged.
"""

from __future__ import annotations

from collections import Counter
from typing import TypeVar

import numpy as np

from fantwin.schemas.blocks import select
from fantwin.schemas.messages import Array, Grid, Prediction
from fantwin.schemas.units import NS_PER_S

BEGINNING_NS = np.iinfo(np.int64).min
REPORTED_AFTER_NS = 10 * NS_PER_S  # of dropped samples in a row
Block = TypeVar("Block", Grid, Prediction)


def are_newer(t_ns: Array, last_t_ns: int) -> Array:
    """Return which samples (n,) are newer than `last_t_ns` and all before them."""
    return t_ns > np.maximum.accumulate(np.concatenate(([last_t_ns], t_ns)))[:-1]


class NewSamples:
    """Drops and counts samples of a tray that are not new, and those of another number of fans."""

    def __init__(self, fans: int, name: str, stages: str) -> None:
        """fans: of the tray. name: of the input, for people. stages: those to restart if its times have gone back."""
        self._fans, self._name, self._stages = fans, name, stages
        self.last_t_ns = BEGINNING_NS
        """time of the newest sample"""
        self._wrong_fans = 0
        self._dropped_ns = self._behind_ns = 0
        """since the last new sample: the time that the dropped ones cover, and how far they are behind it"""
        self._counts: Counter[str] = Counter()

    def fits(self, block: Grid | Prediction) -> bool:
        """Return whether a block is of the fans of the tray. If not, its samples are lost."""
        self._wrong_fans = block.fans if block.fans != self._fans else 0
        if self._wrong_fans:
            self._counts["lost_wrong_fan_count"] += len(block.t_ns)
        return not self._wrong_fans

    def take(self, block: Block) -> Block | None:
        """The new samples of a block; None: it has none."""
        new = are_newer(block.t_ns, self.last_t_ns)
        count = int(np.count_nonzero(new))
        self._counts["repeated"] += len(new) - count
        if not count:
            self._dropped_ns += len(new) * block.period_ns
            self._behind_ns = self.last_t_ns - int(block.t_ns[-1]) if len(new) else self._behind_ns
            return None
        self._dropped_ns = self._behind_ns = 0
        self.last_t_ns = int(block.t_ns[new][-1])
        return block if count == len(new) else select(block, new)

    def counters(self) -> Counter[str]:
        """Samples that were dropped: `repeated` and `lost_wrong_fan_count`, without zeros."""
        return +self._counts

    def problem(self) -> str:
        """Blocks of other fans, or times that have gone back for good, with advice in one line; empty: neither."""
        if self._wrong_fans:
            return f"{self._name} of {self._wrong_fans} fans, [[tray]] says fans = {self._fans}: correct one of them"
        if self._dropped_ns < REPORTED_AFTER_NS:
            return ""
        return (
            f"{self._name} are {self._behind_ns / NS_PER_S:.0f} s older than those before and not judged: the host "
            f"clock was set back, or another recording is replayed; restart {self._stages}"
        )
