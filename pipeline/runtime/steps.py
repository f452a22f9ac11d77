"""The steps of a process: its cores process what is due, and what they make is published.

Blocks of several trays are processed in one pass where that is possible.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from fantwin.pipeline.runtime.health import HealthBuilder
from fantwin.pipeline.runtime.kept_snapshots import KeptForOthers
from fantwin.pipeline.runtime.publishing import Outputs
from fantwin.pipeline.runtime.receiving import Receiver
from fantwin.pipeline.runtime.stage import Admitted, BuiltStage, Core, Joint, Stage
from fantwin.pipeline.timebase.host_clock import HOST_CLOCK
from fantwin.pipeline.timebase.stage_clock import StageClock, is_of_replay
from fantwin.schemas.blocks import join
from fantwin.schemas.envelope import Envelope
from fantwin.schemas.messages import Message, newest_t_ns

MOST_FANS = 512
"""in one pass: with more, a fan costs hardly less"""


def step_together(joint: Joint, cores: Sequence[Core], items: Sequence[Any]) -> list[list[Message]]:
    """The messages of `core.step(item)` for each of several trays: the same, but for rounding."""
    admitted = [core.admit(item) for core, item in zip(cores, items, strict=True)]
    made = [list(each.before) for each in admitted]
    for numbers in _passes(admitted):
        blocks = [admitted[number].block for number in numbers]
        messages = joint.process([cores[number] for number in numbers], blocks)
        for number, message in zip(numbers, messages, strict=True):
            made[number].append(message)
    return made


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


@dataclass(frozen=True, eq=False)
class _Due:
    """An item for a core, and the tray of the message that it is made of."""

    name: str
    tray: str
    item: Any


@dataclass(kw_only=True, eq=False)
class Steps:
    """Runs the steps of all cores of a process, and publishes what they make.

    parts: by the tray that a core serves; an empty name: all.
    """

    stage: Stage
    parts: Mapping[str, BuiltStage]
    receiver: Receiver
    kept: KeptForOthers
    outputs: Outputs
    health: HealthBuilder
    clock: StageClock
    counts: Counter[str] = field(default_factory=Counter)
    active: frozenset[str] = frozenset()
    """the cores of which a method is being called, or has raised"""
    owes_answer: bool = False
    """a command has arrived: the next health, which says so, is sent soon"""

    def __post_init__(self) -> None:
        self._joint = self.stage.joint() if self.stage.joint else None
        self._has_source = any(part.source for part in self.parts.values())

    def step(self, messages: Iterable[Sequence[Envelope]]) -> None:
        """Process groups of messages, each of a different tray; those of a group differ only in their samples."""
        due = [each for envelopes in messages if (each := self._accepted(envelopes))]
        if self._joint is None or len(due) < 2:
            for each in due:
                core = self.parts[each.name].core
                self.call(each.name, lambda core=core, item=each.item: core.step(item), input_tray=each.tray)
            return
        self.active = frozenset(each.name for each in due)
        cores = [self.parts[each.name].core for each in due]
        made = step_together(self._joint, cores, [each.item for each in due])
        for each, of_core in zip(due, made, strict=True):
            self._publish(each.name, of_core, each.tray)
            self.active -= {each.name}

    def call(
        self, name: str, produce: Callable[[], Sequence[Message]], *, input_tray: str = "", from_timer: bool = False
    ) -> None:
        """Let the core called `name` produce messages, and publish them.

        Messages of a core that serves all trays belong to the tray in their header, or else to `input_tray`.
        """
        self.active = frozenset((name,))
        self._publish(name, produce(), input_tray, from_timer=from_timer)
        self.active = frozenset()

    def _accepted(self, envelopes: Sequence[Envelope]) -> _Due | None:
        """What a core is given of messages; None: nothing."""
        first, count = envelopes[0], len(envelopes)
        header = first.header
        name = header.tray if header.tray in self.parts else ""
        if name not in self.parts:
            self.counts["unknown_tray"] += count
            return None
        if self._has_source and is_of_replay(header.producer):  # a recorded command must not drive today's fan
            self.counts["refused_of_replay"] += count
            return None
        for envelope in envelopes:
            self.kept.add(envelope)
        if first.topic == self.stage.reads[0] and not self._has_source:  # samples of a device depend on no input
            for envelope in envelopes:
                self.outputs.advance(header.tray, first.topic, envelope.header)
        self.owes_answer |= self._has_source
        as_it_is = self.stage.wants_envelopes or self.receiver.is_undecoded(first)
        return _Due(name, header.tray, first if as_it_is else join([envelope.message for envelope in envelopes]))

    def _publish(self, name: str, made: Sequence[Message], input_tray: str, *, from_timer: bool = False) -> None:
        for message in made:
            tray = name or message.header.tray or input_tray
            stamped = self.outputs.publish(tray, message, from_timer=from_timer)
            t_ns = newest_t_ns(stamped)
            self.health.add_output(t_ns, HOST_CLOCK.now_ns(), self.clock.now_ns(tray, t_ns))
