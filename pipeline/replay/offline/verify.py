"""Are the scores and alarms that were made anew those of the recording, to the bit?"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, fields
from datetime import UTC, datetime
from typing import Any

import numpy as np

from schemas.blocks import cut
from schemas.envelope import Envelope
from schemas.fast_decode import decode_header, decode_together
from schemas.fields import columns
from schemas.messages import Alarm, Array, Message, Score

NAMED = 5
"""so many differences are told"""
_TOGETHER = 512
_OF_A_SAMPLE = tuple(name for name, column in columns(Score).items() if column.by_sample and name != "t_ns")


@dataclass
class Comparison:
    """Of one tray. Rows are samples of the tray."""

    tray: str
    equal: int = 0
    different: int = 0
    """made anew and not the same"""
    not_made: int = 0
    """recorded, and not made anew"""
    not_recorded: int = 0
    """made anew, and not in the recording: what was under way when it ended, or was lost"""
    alarms_equal: int = 0
    alarms_different: int = 0
    alarms_not_recorded: int = 0
    """made anew beyond the last score that is recorded of their session"""
    named: list[str] = field(default_factory=list)
    """the first differences, a line each"""

    @property
    def is_equal(self) -> bool:
        """Nothing differs."""
        return not (self.different or self.not_made or self.alarms_different)

    def name(self, difference: str) -> None:
        """Note a difference, if it is one of the first."""
        if len(self.named) < NAMED:
            self.named.append(difference)


class RecordedSession:
    """The recorded scores of one session of the scorer, in order, each once."""

    def __init__(self, packets: Iterable[Envelope], producer: str) -> None:
        self._blocks = _scores(packets, producer)
        self._rest: Score | None = next(self._blocks, None)

    def until(self, t_ns: int | None) -> Iterator[Score]:
        """The next rows up to a time, both included; None: all that are left."""
        while self._rest is not None:
            block = self._rest
            last = len(block.t_ns) if t_ns is None else int(np.searchsorted(block.t_ns, t_ns, side="right"))
            if last:
                yield cut(block, 0, last)
            if last < len(block.t_ns):
                self._rest = cut(block, last, len(block.t_ns))
                return
            self._rest = next(self._blocks, None)


def compare_scores(made: Score, recorded: RecordedSession, found: Comparison) -> None:
    """Hold a block of scores against what was recorded up to its last sample."""
    taken = 0
    for block in recorded.until(int(made.t_ns[-1])):
        at = np.searchsorted(made.t_ns, block.t_ns)
        is_made = (at < len(made.t_ns)) & (made.t_ns[np.minimum(at, len(made.t_ns) - 1)] == block.t_ns)
        note_not_made(block.t_ns[~is_made], found)
        rows = at[is_made]
        taken += len(rows)
        different = np.zeros(len(rows), np.bool_)
        if block.fans != made.fans:
            different[:] = True
            found.name(f"{found.tray}: {made.fans} fans made, {block.fans} recorded")
        else:
            for name in _OF_A_SAMPLE:
                differs = _differ(getattr(made, name)[rows], getattr(block, name)[is_made])
                if differs.any():
                    _name_first(found, name, block.t_ns[is_made], differs, made, block, rows, is_made)
                    different |= differs.any(axis=1)
        found.different += int(different.sum())
        found.equal += int((~different).sum())
    found.not_recorded += len(made.t_ns) - taken


def note_not_made(t_ns: Array, found: Comparison) -> None:
    """Note rows that were recorded and that no stage made anew."""
    if len(t_ns):
        found.not_made += len(t_ns)
        found.name(f"{found.tray}: {when(int(t_ns[0]))}: recorded and not made anew, {len(t_ns)} samples")


def compare_alarms(made: Iterable[Alarm], recorded: Iterable[Alarm], last_scored_t_ns: int, found: Comparison) -> None:
    """Hold the alarms of one session against those recorded: each is named by fan, time, transition and request.

    An alarm leaves right after its score: of the last score that was recorded it may be missing, and after that it is.
    """
    left = {(alarm.fan, alarm.t_ns, alarm.transition, alarm.request): alarm for alarm in recorded}
    for alarm in made:
        other = left.pop((alarm.fan, alarm.t_ns, alarm.transition, alarm.request), None)
        if other is not None and _without_header(alarm) == _without_header(other):
            found.alarms_equal += 1
        elif other is not None:
            found.alarms_different += 1
            found.name(f"{found.tray}: alarm {_said(alarm)} made, {other.message!r} recorded")
        elif alarm.t_ns >= last_scored_t_ns:
            found.alarms_not_recorded += 1
        else:
            found.alarms_different += 1
            found.name(f"{found.tray}: alarm {_said(alarm)} made, none recorded")
    for alarm in left.values():
        found.alarms_different += 1
        found.name(f"{found.tray}: alarm {_said(alarm)} recorded, none made")


def when(t_ns: int) -> str:
    """A time as people read it."""
    return datetime.fromtimestamp(t_ns / 1e9, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


def _scores(packets: Iterable[Envelope], producer: str) -> Iterator[Score]:
    waiting: list[bytes] = []
    following = 0
    for packet in packets:
        header = decode_header(packet)
        if header.producer == producer and header.sequence >= following:
            following = header.sequence + 1
            waiting.append(packet.payload)
            if len(waiting) == _TOGETHER:
                yield from decode_together(Score, waiting)
                waiting = []
    yield from decode_together(Score, waiting)


def _differ(one: Array, other: Array) -> Array:
    """(n, fans): which values are not the same to the bit; every NaN is the same."""
    if one.dtype.kind != "f":
        return one != other
    bits = np.ascontiguousarray(one).view(np.int64) != np.ascontiguousarray(other).view(np.int64)
    return bits & ~(np.isnan(one) & np.isnan(other))


def _name_first(
    found: Comparison, name: str, t_ns: Array, differs: Array, made: Score, block: Score, rows: Array, is_made: Array
) -> None:
    row, fan = np.argwhere(differs)[0].tolist()
    one = getattr(made, name)[rows][row, fan]
    other = getattr(block, name)[is_made][row, fan]
    found.name(
        f"{found.tray}: {when(int(t_ns[row]))}, fan {fan}: {name} {one!s} made, {other!s} recorded "
        f"(in {int(differs.any(axis=1).sum())} of {len(rows)} samples from here on)"
    )


def _without_header(message: Message) -> tuple[Any, ...]:
    return tuple(getattr(message, f.name) for f in fields(message) if f.name != "header")


def _said(alarm: Alarm) -> str:
    return f"{alarm.transition.name.lower()} at {when(alarm.t_ns)}, {alarm.message!r},"
