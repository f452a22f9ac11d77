"""Steps of the cores of several trays at once: blocks that can be processed in one pass are."""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Sequence
from typing import Any

from fantwin.pipeline.runtime.stage import Admitted, Core, Joint
from fantwin.schemas.messages import Message

MOST_FANS = 512
"""in one pass: with more, a fan costs hardly less"""


def step_together(joint: Joint, cores: Sequence[Core], items: Sequence[Any]) -> Iterator[list[Message]]:
    """The messages of `core.step(item)` for each of several trays: the same decisions; numbers may differ by rounding.

    A core finishes its step only when its messages are taken, so what it saves is never ahead of what is published.
    """
    admitted = [core.admit(item) for core, item in zip(cores, items, strict=True)]
    made: dict[int, Any] = {}
    for numbers in _passes(admitted):
        blocks = [admitted[number].block for number in numbers]
        made |= zip(numbers, joint.process([cores[number] for number in numbers], blocks), strict=True)
    for number, (core, each) in enumerate(zip(cores, admitted, strict=True)):
        yield [*each.before, *(core.finish(each.block, made[number]) if number in made else ())]


def _passes(admitted: Sequence[Admitted]) -> list[list[int]]:
    """The numbers of the blocks that are processed together."""
    by_key: dict[Hashable, list[int]] = {}
    for number, each in enumerate(admitted):
        if each.block is not None:
            by_key.setdefault(("alone", number) if each.key is None else each.key, []).append(number)
    passes: list[list[int]] = []
    for numbers in by_key.values():
        most = max(1, MOST_FANS // admitted[numbers[0]].block.fans)
        passes += [numbers[first : first + most] for first in range(0, len(numbers), most)]
    return passes
