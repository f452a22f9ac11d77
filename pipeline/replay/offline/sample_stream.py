"""The samples that one session of a stage makes, for the sessions of the next stage that consume them."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from typing import Generic, TypeVar

import numpy as np

from fantwin.pipeline.replay.offline.plan import Span
from fantwin.schemas.blocks import cut
from fantwin.schemas.messages import Grid, Prediction, Score

Samples = TypeVar("Samples", bound=Grid | Prediction | Score)


class SampleStream(Generic[Samples]):
    """Blocks that are made when they are asked for; those that a later span contains as well are kept until then."""

    def __init__(self, blocks: Iterator[Samples]) -> None:
        self._blocks = blocks
        self._kept: deque[Samples] = deque()

    def of(self, span: Span) -> Iterator[Samples]:
        """The samples of a span. Spans are asked for in the order of the plan."""
        for block in self._from_kept(span.wanted_again_from):
            first = int(np.searchsorted(block.t_ns, span.first, side="left"))
            end = len(block.t_ns)
            if span.last is not None:
                end = int(np.searchsorted(block.t_ns, span.last, side="right"))
            if first < end:
                yield block if (first, end) == (0, len(block.t_ns)) else cut(block, first, end)
            if span.last is not None and block.t_ns[-1] >= span.last:
                return

    def _from_kept(self, wanted_again_from: int | None) -> Iterator[Samples]:
        def is_wanted_again(block: Samples) -> bool:
            return wanted_again_from is not None and int(block.t_ns[-1]) >= wanted_again_from

        kept = tuple(self._kept)
        self._kept = deque(filter(is_wanted_again, kept))
        yield from kept
        for block in self._blocks:
            if is_wanted_again(block):
                self._kept.append(block)
            yield block
