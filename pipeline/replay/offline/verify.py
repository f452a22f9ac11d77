"""Comparison of replayed scores and alarms with the recorded ones; of snapshots if scores are not recorded.

Decisions must be equal: states, statistics, validity and its reasons, times, and alarms with the order of their causes.
Numbers may differ within a tolerance (pipeline.replay.offline.tolerance).
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict

import numpy as np

from pipeline.recordings.dates import format_utc
from pipeline.replay.offline.compare_snapshots import SnapshotVerifier
from pipeline.replay.offline.comparison import Comparison
from pipeline.replay.offline.plan import BEGINNING, Limit, Session
from pipeline.replay.offline.tolerance import Apart, differences, shares
from schemas.blocks import cut
from schemas.enums import Transition
from schemas.envelope import Envelope
from schemas.fast_decode import decode_header, decode_together
from schemas.fields import columns
from schemas.messages import Alarm, Array, Score, ScorerSnapshot

SCORE, SNAPSHOT = "score", "snapshot"
CAUSES = "causes of alarms soon after the beginning of a clip rest on samples from before it"
AT_A_LIMIT = (
    "although all numbers agree within the tolerance: one lies so close to its limit that processors decide "
    "differently, or the way of deciding has changed"
)
_BLOCK_MESSAGES = 512
_SAMPLE_COLUMNS = {
    name: column.dtype
    for name, column in columns(Score).items()
    if column.by_sample and not column.optional and name != "t_ns"
}
"""optional ones are only passed on from the source"""


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
        self._limit_of = limit_of
        self._producer: str | None = None
        self._recorded: RecordedSession | None = None
        self._visited: set[str] = set()
        self._found = Comparison(tray, has_scores=SCORE not in left_out)
        self._snapshots = SnapshotVerifier(lambda: read(SNAPSHOT), limit_of, self._found)

    def add(self, producer: str, message: Score | ScorerSnapshot) -> None:
        """Compare the next scores or snapshot that were replayed, of the recorded session `producer`."""
        if isinstance(message, Score) and self._found.has_scores:
            self._add_score(producer, message)
        elif isinstance(message, ScorerSnapshot) and not (message.restored or self._found.has_scores):
            self._snapshots.add(producer, message)

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
            compare_alarms(replayed, known, session.last_t_ns, self._found, limit, session.causes_from_t_ns)
            if limit is not None and limit.t_ns < session.last_t_ns and not self._found.has_scores:
                self._found.add_limit(limit)
        return self._found

    def _finish_scores(self, sessions: Sequence[Session]) -> None:
        self._end_session()
        for session in sessions:
            if session.producer not in self._visited:
                self._recorded = self._begin_session(session.producer)
                self._end_session()

    def _begin_session(self, producer: str) -> RecordedSession:
        self._producer = producer
        self._visited.add(producer)
        return RecordedSession(self._read(SCORE), producer)

    def _end_session(self) -> None:
        if self._recorded and self._producer is not None:
            limit = self._limit_of(self._producer)
            for block in self._recorded.until(None):
                count_not_made(block.t_ns, self._found, limit)
        self._recorded = None


class RecordedSession:
    """The recorded scores of one session of the scorer, in order, each once."""

    def __init__(self, envelopes: Iterable[Envelope], producer: str) -> None:
        self._blocks = _scores(envelopes, producer)
        self._rest: Score | None = next(self._blocks, None)

    def until(self, t_ns: int | None) -> Iterator[Score]:
        """The next samples up to and including a time; None: all that are left."""
        while self._rest is not None:
            block = self._rest
            last = len(block.t_ns) if t_ns is None else int(np.searchsorted(block.t_ns, t_ns, side="right"))
            if last:
                yield cut(block, 0, last)
            if last < len(block.t_ns):
                self._rest = cut(block, last, len(block.t_ns))
                return
            self._rest = next(self._blocks, None)


def compare_scores(made: Score, recorded: RecordedSession, found: Comparison, limit: Limit | None = None) -> None:
    """Compare a block of scores with the recorded ones up to its last sample."""
    taken = 0
    for block in recorded.until(int(made.t_ns[-1])):
        at = np.searchsorted(made.t_ns, block.t_ns)
        is_made = (at < len(made.t_ns)) & (made.t_ns[np.minimum(at, len(made.t_ns) - 1)] == block.t_ns)
        count_not_made(block.t_ns[~is_made], found, limit)
        rows = at[is_made]
        taken += len(rows)
        within = _within(block.t_ns[is_made], limit)
        if block.fans != made.fans:
            different = np.ones(len(rows), np.bool_)
            found.name(f"{found.tray}: {made.fans} fans replayed, {block.fans} recorded")
        else:
            one, other = _columns(made, rows), _columns(block, is_made)
            different = _compare_samples(block.t_ns[is_made], one, other, within, found)
        if limit is not None:
            found.add_not_comparable(int((different & ~within).sum()), limit)
        found.different += int((different & within).sum())
        found.equal += int((~different).sum())
    found.not_recorded += len(made.t_ns) - taken


def _columns(score: Score, rows: Array) -> dict[str, Array]:
    return {name: getattr(score, name)[rows].astype(dtype) for name, dtype in _SAMPLE_COLUMNS.items()}


def _compare_samples(
    t_ns: Array, made: Mapping[str, Array], recorded: Mapping[str, Array], within: Array, found: Comparison
) -> Array:
    """(n,) whether a sample differs. within: (n,) samples within the limit of their session; only these are named."""
    differ = {name: _differ(name, values, recorded[name], found) for name, values in made.items()}
    is_number = {name: values.dtype.kind == "f" for name, values in made.items()}
    number_differs = np.any([differs for name, differs in differ.items() if is_number[name]], axis=0)
    found.numbers_different += int((number_differs.any(axis=1) & within).sum())
    for name, differs in differ.items():
        named = differs & within[:, np.newaxis]
        if named.any():
            row, fan = np.argwhere(named)[0].tolist()
            found.name(
                f"{found.tray}: {format_utc(int(t_ns[row]))}, fan {fan}: {name} {made[name][row, fan]!s} replayed, "
                f"{recorded[name][row, fan]!s} recorded (in {int(named.any(axis=1).sum())} of {len(t_ns)} samples "
                f"from here on){'' if number_differs[row, fan] else ', ' + AT_A_LIMIT}"
            )
    return np.any([differs.any(axis=1) for differs in differ.values()], axis=0)


def _differ(name: str, one: Array, other: Array, found: Comparison) -> Array:
    """(n, fans) which values differ: decisions at all, numbers by more than the tolerance. All NaN are equal."""
    differs = one != other
    if one.dtype.kind == "f":
        differs &= ~(np.isnan(one) & np.isnan(other))
        one, other = one[differs], other[differs]
        share = shares(name, one, other)
        differs[differs] = share > 1.0
        if (allowed := share <= 1.0).any():
            largest = int(np.argmax(np.where(allowed, share, 0.0)))
            found.note(Apart(float(share[largest]), name, abs(float(one[largest]) - float(other[largest]))))
    return differs


def _within(t_ns: Array, limit: Limit | None) -> Array:
    return np.ones(len(t_ns), np.bool_) if limit is None else t_ns <= limit.t_ns


def count_not_made(t_ns: Array, found: Comparison, limit: Limit | None = None) -> None:
    """Count samples that were recorded and not replayed."""
    if limit is not None:
        within = _within(t_ns, limit)
        found.add_not_comparable(int((~within).sum()), limit)
        t_ns = t_ns[within]
    if len(t_ns):
        found.not_made += len(t_ns)
        found.name(f"{found.tray}: {format_utc(int(t_ns[0]))}: recorded and not replayed, {len(t_ns)} samples")


def compare_alarms(
    made: Iterable[Alarm],
    recorded: Iterable[Alarm],
    last_scored_t_ns: int,
    found: Comparison,
    limit: Limit | None = None,
    causes_from_t_ns: int = BEGINNING,
) -> None:
    """Compare the alarms of one session with the recorded ones, matched by fan, time, transition and request.

    An alarm is published right after its score, so those of the last recorded score may be missing in the recording.
    causes_from_t_ns: the causes of earlier ones rest on samples that the recording lacks.
    """

    def is_of_causes(alarm: Alarm, other: Alarm | None) -> bool:
        """Whether only the causes may differ."""
        is_same = other is not None and not first_difference(alarm, other, found.note, ("causes", "message"))
        return alarm.t_ns < causes_from_t_ns and (is_same or alarm.transition == Transition.DIAGNOSED)

    at_a_limit = f" ({AT_A_LIMIT})" if found.equal and not found.numbers_different else ""
    left = {(alarm.fan, alarm.t_ns, alarm.transition, alarm.request): alarm for alarm in recorded}
    for alarm in made:
        other = left.pop((alarm.fan, alarm.t_ns, alarm.transition, alarm.request), None)
        where = first_difference(alarm, other, found.note) if other is not None else ""
        if other is not None and not where:
            found.alarms_equal += 1
        elif limit is not None and alarm.t_ns > limit.t_ns:
            found.alarms_not_comparable += 1
        elif is_of_causes(alarm, other):
            found.alarms_not_comparable += 1
            found.add_reason(f"{found.tray}: {CAUSES}")
        elif other is not None:
            found.alarms_different += 1
            found.name(f"{found.tray}: alarm {_describe(alarm)} replayed, {other.message!r} recorded: {where} differs")
        elif alarm.t_ns >= last_scored_t_ns:
            found.alarms_not_recorded += 1
        else:
            found.alarms_different += 1
            found.name(f"{found.tray}: alarm {_describe(alarm)} replayed, none recorded{at_a_limit}")
    for alarm in left.values():
        if limit is not None and alarm.t_ns > limit.t_ns:
            found.alarms_not_comparable += 1
            continue
        if is_of_causes(alarm, None):
            found.alarms_not_comparable += 1
            found.add_reason(f"{found.tray}: {CAUSES}")
            continue
        found.alarms_different += 1
        found.name(f"{found.tray}: alarm {_describe(alarm)} recorded, none replayed{at_a_limit}")


def _scores(envelopes: Iterable[Envelope], producer: str) -> Iterator[Score]:
    waiting: list[bytes] = []
    next_sequence = 0
    for envelope in envelopes:
        header = decode_header(envelope)
        if header.producer == producer and header.sequence >= next_sequence:
            next_sequence = header.sequence + 1
            waiting.append(envelope.payload)
            if len(waiting) == _BLOCK_MESSAGES:
                yield from decode_together(Score, waiting)
                waiting = []
    yield from decode_together(Score, waiting)


def first_difference(alarm: Alarm, other: Alarm, note: Callable[[Apart], None], left_out: Collection[str] = ()) -> str:
    """The first field in which two alarms differ by more than the tolerance; empty if none. left_out: may differ."""
    one, beside = (
        {name: value for name, value in asdict(each).items() if name not in ("header", *left_out)}
        for each in (alarm, other)
    )
    return next(differences(one, beside, note), "")


def _describe(alarm: Alarm) -> str:
    return f"{alarm.transition.name.lower()} at {format_utc(alarm.t_ns)}, {alarm.message!r},"
