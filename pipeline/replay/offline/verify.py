"""Comparison of replayed scores and alarms with the recorded ones; of snapshots if scores are not recorded.

Decisions must be equal: states, statistics, validity and its reasons, times, and alarms with the order of their causes.
Numbers may differ within a tolerance (pipeline.replay.offline.comparison).
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import asdict
from functools import cache
from typing import Any, Generic, TypeVar

import numpy as np

from fantwin.pipeline.recordings.dates import format_utc
from fantwin.pipeline.replay.offline.comparison import Apart, Comparison, SnapshotVerifier, differences, unequal
from fantwin.pipeline.replay.offline.plan import UNLIMITED, Limit, Session
from fantwin.schemas.blocks import cut
from fantwin.schemas.codec import decode_together
from fantwin.schemas.enums import Transition
from fantwin.schemas.envelope import Envelope
from fantwin.schemas.fields import columns
from fantwin.schemas.messages import Alarm, Array, Grid, Message, Prediction, Score, ScorerSnapshot

Samples = TypeVar("Samples", bound=Grid | Prediction | Score)

SCORE, SNAPSHOT = "score", "snapshot"
AT_A_LIMIT = (
    "although all numbers agree within the tolerance: one lies so close to its limit that processors decide "
    "differently, or the way of deciding has changed"
)
_BLOCK_MESSAGES = 512
_INPUTS = {Grid: "grid", Prediction: "prediction"}


class TrayVerifier:
    """Compares what a replay of one tray makes with the recording, session by session.

    What differs beyond the limit of its session is not a difference of the code: the recording lacks what it was
    computed from.
    """

    def __init__(
        self,
        tray: str,
        read: Callable[[str], Iterable[Envelope]],
        limit_of: Callable[[str], Limit | None],
        left_out: Collection[str] = (),
    ) -> None:
        """read: the recorded messages of a topic of the tray, from the beginning at each call. limit_of: the limit of a
        session of the scorer, as known when its last scores were made. left_out: topics that are not recorded."""
        self._read = read
        self._limit_of: Callable[[str], Limit] = lambda producer: limit_of(producer) or UNLIMITED
        self._producer: str | None = None
        self._recorded: RecordedSession[Score] | None = None
        self._visited: set[str] = set()
        self._inputs: dict[str, RecordedSession[Grid | Prediction]] = {}
        """by producer"""
        self._found = Comparison(tray, has_scores=SCORE not in left_out)
        self._snapshots = SnapshotVerifier(lambda: read(SNAPSHOT), self._limit_of, self._found)

    def add(self, producer: str, message: Score | ScorerSnapshot) -> None:
        """Compare the next scores or snapshot that were replayed, of the recorded session `producer`."""
        if isinstance(message, Score) and self._found.has_scores:
            self._add_score(producer, message)
        elif isinstance(message, ScorerSnapshot) and not (message.restored or self._found.has_scores):
            self._snapshots.add(producer, message)

    def add_input(self, block: Grid | Prediction) -> None:
        """Compare the next samples that a stage made for the next one, of the recorded session that they name."""
        producer = block.header.producer
        if producer not in self._inputs:
            self._inputs[producer] = RecordedSession(self._read(_INPUTS[type(block)]), producer, type(block))
        compare_inputs(block, self._inputs[producer], self._found, self._limit_of(producer))

    def _add_score(self, producer: str, score: Score) -> None:
        if self._recorded is None or producer != self._producer:
            self._end_session()
            self._recorded = self._begin_session(producer)
        compare_scores(score, self._recorded, self._found, self._limit_of(producer))

    def finish(self, sessions: Sequence[Session], alarms: Sequence[Alarm], recorded: Sequence[Alarm]) -> Comparison:
        """Compare what is left, and the alarms; the result."""
        if self._found.has_scores:
            self._finish_scores(sessions)
        else:
            self._snapshots.finish(sessions)
        for session in sessions:
            replayed, known = (
                [alarm for alarm in listed if alarm.header.producer == session.producer]
                for listed in (alarms, recorded)
            )
            limit = self._limit_of(session.producer)
            compare_alarms(replayed, known, session.last_t_ns, self._found, limit)
            if limit.t_ns < session.last_t_ns and not self._found.has_scores:
                self._found.add_limit(limit)
        if holes := self._found.holes:
            self._found.add_reason(f"{self._found.tray}: the recording lacks {holes} scored samples between others")
        return self._found

    def _finish_scores(self, sessions: Sequence[Session]) -> None:
        self._end_session()
        for session in sessions:
            if session.producer not in self._visited:
                self._recorded = self._begin_session(session.producer)
                self._end_session()

    def _begin_session(self, producer: str) -> RecordedSession[Score]:
        self._producer = producer
        self._visited.add(producer)
        return RecordedSession(self._read(SCORE), producer, Score)

    def _end_session(self) -> None:
        if self._recorded and self._producer is not None:
            limit = self._limit_of(self._producer)
            for block in self._recorded.until(None):
                count_not_made(block.t_ns, self._found, limit)
        self._recorded = None


class RecordedSession(Generic[Samples]):
    """The recorded samples of one session of a stage, in order, each once."""

    def __init__(self, envelopes: Iterable[Envelope], producer: str, kind: type[Samples]) -> None:
        self._blocks = _blocks(envelopes, producer, kind)
        self._rest: Samples | None = next(self._blocks, None)
        self.has_begun = False
        """whether samples have been taken"""

    @property
    def has_more(self) -> bool:
        """Whether samples are left."""
        return self._rest is not None

    def until(self, t_ns: int | None) -> Iterator[Samples]:
        """The next samples up to and including a time; None: all that are left."""
        while self._rest is not None:
            block = self._rest
            last = len(block.t_ns) if t_ns is None else int(np.searchsorted(block.t_ns, t_ns, side="right"))
            if last:
                self.has_begun = True
                yield cut(block, 0, last)
            if last < len(block.t_ns):
                self._rest = cut(block, last, len(block.t_ns))
                return
            self._rest = next(self._blocks, None)


def compare_inputs(
    made: Samples, recorded: RecordedSession[Samples], found: Comparison, limit: Limit = UNLIMITED
) -> None:
    """Compare a block of another stage than the scorer with what is recorded of it, up to its last sample."""
    for block, rows, is_made in _beside(made, recorded):
        if block.fans == made.fans and len(rows):
            different = _compare_samples(made, rows, block, is_made, limit, found, f"{_INPUTS[type(made)]}.")
            found.inputs_different += int((different & (block.t_ns[is_made] <= limit.t_ns)).sum())


def compare_scores(made: Score, recorded: RecordedSession[Score], found: Comparison, limit: Limit = UNLIMITED) -> None:
    """Compare a block of scores with the recorded ones up to its last sample."""
    is_taken = np.zeros(len(made.t_ns), np.bool_)
    had_begun = recorded.has_begun
    for block, rows, is_made in _beside(made, recorded):
        count_not_made(block.t_ns[~is_made], found, limit)
        is_taken[rows] = True
        within = block.t_ns[is_made] <= limit.t_ns
        if block.fans != made.fans:
            different = np.ones(len(rows), np.bool_)
            found.name(f"{found.tray}: {made.fans} fans replayed, {block.fans} recorded")
        else:
            different = _compare_samples(made, rows, block, is_made, limit, found)
        found.add_not_comparable(int((different & ~within).sum()), limit)
        found.different += int((different & within).sum())
        found.equal += int((~different).sum())
    found.not_recorded += int((~is_taken).sum())
    taken = np.flatnonzero(is_taken)
    between = slice(
        0 if had_begun else int(taken[0]) if len(taken) else len(is_taken),
        len(is_taken) if recorded.has_more else int(taken[-1]) if len(taken) else 0,
    )
    found.holes += int((~is_taken & (made.t_ns <= limit.t_ns))[between].sum())


def _beside(made: Samples, recorded: RecordedSession[Samples]) -> Iterator[tuple[Samples, Array, Array]]:
    """The recorded blocks up to the last sample of a replayed one; the rows of it that are recorded, and which of the
    recorded ones they are, (n,) of bool."""
    for block in recorded.until(int(made.t_ns[-1])):
        at = np.searchsorted(made.t_ns, block.t_ns)
        is_made = (at < len(made.t_ns)) & (made.t_ns[np.minimum(at, len(made.t_ns) - 1)] == block.t_ns)
        yield block, at[is_made], is_made


@cache
def _dtypes(kind: type[Message]) -> dict[str, np.dtype[Any]]:
    """The columns that are compared; optional ones are only passed on from the source."""
    return {
        name: column.dtype
        for name, column in columns(kind).items()
        if column.by_sample and not column.optional and name != "t_ns"
    }


def _compare_samples(
    made: Samples, rows: Array, recorded: Samples, is_made: Array, limit: Limit, found: Comparison, prefix: str = ""
) -> Array:
    """(n,) whether a sample differs; only those within the limit of their session are named."""
    t_ns = recorded.t_ns[is_made]
    within = t_ns <= limit.t_ns
    one, other = (
        {f"{prefix}{name}": getattr(message, name)[of].astype(dtype) for name, dtype in _dtypes(type(message)).items()}
        for message, of in ((made, rows), (recorded, is_made))
    )
    differ = {name: _differ(name, values, other[name], found) for name, values in one.items()}
    number_differs = np.any([differs for name, differs in differ.items() if one[name].dtype.kind == "f"], axis=0)
    found.numbers_different += int((number_differs.any(axis=1) & within).sum())
    for name, differs in differ.items():
        named = differs & within[:, np.newaxis]
        if named.any():
            row, fan = np.argwhere(named)[0].tolist()
            found.name(
                f"{found.tray}: {format_utc(int(t_ns[row]))}, fan {fan}: {name} {one[name][row, fan]!s} replayed, "
                f"{other[name][row, fan]!s} recorded (in {int(named.any(axis=1).sum())} of {len(t_ns)} samples "
                f"from here on){'' if number_differs[row, fan] else ', ' + AT_A_LIMIT}"
            )
    return np.any([differs.any(axis=1) for differs in differ.values()], axis=0)


def _differ(name: str, one: Array, other: Array, found: Comparison) -> Array:
    """(n, fans) which values differ: decisions at all, numbers by more than the tolerance. All NaN are equal."""
    differs, share = unequal(name, one, other)
    if (allowed := share <= 1.0).any():
        largest = int(np.argmax(np.where(allowed, share, 0.0)))
        difference = abs(float(one[differs][largest]) - float(other[differs][largest]))
        found.note(Apart(float(share[largest]), name, difference))
    differs[differs] = share > 1.0
    return differs


def count_not_made(t_ns: Array, found: Comparison, limit: Limit = UNLIMITED) -> None:
    """Count samples that were recorded and not replayed."""
    within = t_ns <= limit.t_ns
    found.add_not_comparable(int((~within).sum()), limit)
    if within.any():
        found.not_made += int(within.sum())
        first_t_ns = int(t_ns[within][0])
        found.name(f"{found.tray}: {format_utc(first_t_ns)}: recorded and not replayed, {int(within.sum())} samples")


def compare_alarms(
    made: Iterable[Alarm],
    recorded: Iterable[Alarm],
    last_scored_t_ns: int,
    found: Comparison,
    limit: Limit = UNLIMITED,
) -> None:
    """Compare the alarms of one session with the recorded ones, matched by fan, time, transition and request.

    An alarm is published right after its score, so those of the last recorded score may be missing in the recording.
    """
    at_a_limit = f" ({AT_A_LIMIT})" if found.equal and not found.numbers_different else ""
    left = {_key(alarm): alarm for alarm in recorded}
    for alarm in made:
        other = left.pop(_key(alarm), None)
        where = first_difference(alarm, other, found.note) if other is not None else ""
        if other is not None and not where:
            found.alarms_equal += 1
        elif alarm.t_ns > limit.t_ns:
            found.alarms_not_comparable += 1
        elif other is not None:
            found.alarms_different += 1
            found.name(f"{found.tray}: alarm {_describe(alarm)} replayed, {other.message!r} recorded: {where} differs")
        elif alarm.t_ns >= last_scored_t_ns:
            found.alarms_not_recorded += 1
        else:
            found.alarms_different += 1
            found.name(f"{found.tray}: alarm {_describe(alarm)} replayed, none recorded{at_a_limit}")
    for alarm in left.values():
        if alarm.t_ns > limit.t_ns:
            found.alarms_not_comparable += 1
            continue
        found.alarms_different += 1
        found.name(f"{found.tray}: alarm {_describe(alarm)} recorded, none replayed{at_a_limit}")


def _key(alarm: Alarm) -> tuple[int, int, Transition, str]:
    return alarm.fan, alarm.t_ns, alarm.transition, alarm.request


def _blocks(envelopes: Iterable[Envelope], producer: str, kind: type[Samples]) -> Iterator[Samples]:
    waiting: list[bytes] = []
    next_sequence = 0
    for envelope in envelopes:
        header = envelope.header
        if header.producer == producer and header.sequence >= next_sequence:
            next_sequence = header.sequence + 1
            waiting.append(envelope.payload)
            if len(waiting) == _BLOCK_MESSAGES:
                yield from decode_together(kind, waiting)
                waiting = []
    yield from decode_together(kind, waiting)


def first_difference(alarm: Alarm, other: Alarm, note: Callable[[Apart], None]) -> str:
    """The first field in which two alarms differ by more than the tolerance; empty if none."""
    one, beside = ({name: value for name, value in asdict(each).items() if name != "header"} for each in (alarm, other))
    return next(differences(one, beside, note), "")


def _describe(alarm: Alarm) -> str:
    return f"{alarm.transition.name.lower()} at {format_utc(alarm.t_ns)}, {alarm.message!r},"
