"""Comparison of replayed scores and alarms with the recorded ones; of snapshots if scores are not recorded.

Decisions must be equal: states, statistics, validity and its reasons, times, and alarms with the order of their causes.
Numbers may differ within a tolerance (pipeline.replay.offline.comparison).
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict
from functools import cache
from itertools import islice
from typing import Any, TypeAlias

import numpy as np

from fantwin.pipeline.recordings.dates import format_utc
from fantwin.pipeline.replay.offline.comparison import Apart, Comparison, differences, unequal
from fantwin.pipeline.replay.offline.plan import UNLIMITED, Limit, Session
from fantwin.schemas.blocks import cut
from fantwin.schemas.codec import CodecError, decode_together
from fantwin.schemas.enums import Transition
from fantwin.schemas.envelope import Envelope
from fantwin.schemas.fields import columns
from fantwin.schemas.messages import Alarm, Array, Grid, Message, Overview, Prediction, Score, ScorerSnapshot
from fantwin.scoring.saved import from_json

Samples: TypeAlias = Grid | Prediction | Score | Overview

AT_A_LIMIT = (
    "although all numbers agree within the tolerance: one lies so close to its limit that processors decide "
    "differently, or the way of deciding has changed"
)
_BLOCK_MESSAGES = 512
_TOPICS: dict[type[Message], str] = {
    Grid: "grid",
    Prediction: "prediction",
    Score: "score",
    Overview: "overview",
}


class TrayVerifier:
    """Compares what a replay of one tray makes with the recording, session by session.

    What differs beyond the limit of its session is not a difference of the code: the recording lacks what it was
    computed from. Where scores are not recorded, snapshots show that every statistic and alarm was the same, and all
    that was learned of the fans.
    """

    def __init__(
        self,
        tray: str,
        read: Callable[[str], Iterable[Envelope]],
        limit_of: Callable[[str], Limit | None],
        left_out: tuple[str, ...] = (),
    ) -> None:
        """read: the recorded messages of a topic of the tray, from the beginning at each call. limit_of: the limit of a
        session, as known by now. left_out: topics that are not recorded."""
        self._read = read
        self._limit_of: Callable[[str], Limit] = lambda producer: limit_of(producer) or UNLIMITED
        self._samples: dict[tuple[type[Samples], str], RecordedSamples] = {}
        self._snapshots: dict[str, _RecordedSnapshots] = {}
        self._found = Comparison(tray, left_out)

    def add(self, producer: str, message: Message) -> None:
        """Compare the next message that was replayed, of the recorded session `producer`."""
        is_compared = isinstance(message, Grid | Prediction | Overview)
        if is_compared or (isinstance(message, Score) and self._found.has_scores):
            compare_samples(message, self._samples_of(type(message), producer), self._found, self._limit_of(producer))
        elif isinstance(message, ScorerSnapshot) and not (message.restored or self._found.has_scores):
            self._snapshots_of(producer).add(message)

    def finish(self, sessions: Sequence[Session], alarms: Sequence[Alarm], recorded: Sequence[Alarm]) -> Comparison:
        """Compare what is left, and the alarms; the result."""
        found = self._found
        for session in sessions:
            producer, limit = session.producer, self._limit_of(session.producer)
            if found.has_scores:
                for block in self._samples_of(Score, producer).until(None):
                    _count_not_made(block.t_ns, found, limit)
            else:
                self._snapshots_of(producer).settle(None)
            replayed, known = (
                [alarm for alarm in listed if alarm.header.producer == producer] for listed in (alarms, recorded)
            )
            compare_alarms(replayed, known, session.last_t_ns, found, limit)
            if limit.t_ns < session.last_t_ns and not found.has_scores:
                found.add_limit(limit)
        if found.holes:
            found.add_reason(f"{found.tray}: the recording lacks {found.holes} scored samples between others")
        return found

    def _samples_of(self, kind: type[Samples], producer: str) -> RecordedSamples:
        if (kind, producer) not in self._samples:
            self._samples[kind, producer] = RecordedSamples(self._read(_TOPICS[kind]), producer, kind)
        return self._samples[kind, producer]

    def _snapshots_of(self, producer: str) -> _RecordedSnapshots:
        if producer not in self._snapshots:
            recorded = _saved(self._read("snapshot"), producer)
            self._snapshots[producer] = _RecordedSnapshots(recorded, self._found, lambda: self._limit_of(producer))
        return self._snapshots[producer]


class RecordedSamples:
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
        while (block := self._rest) is not None:
            last = len(block.t_ns) if t_ns is None else int(np.searchsorted(block.t_ns, t_ns, side="right"))
            if last:
                self.has_begun = True
                yield cut(block, 0, last)
            if last < len(block.t_ns):
                self._rest = cut(block, last, len(block.t_ns))
                return
            self._rest = next(self._blocks, None)


def compare_samples(made: Samples, recorded: RecordedSamples, found: Comparison, limit: Limit = UNLIMITED) -> None:
    """Compare a block of samples with the recorded ones up to its last sample. Of others than scores only those count
    that are recorded and replayed: a session may have made more than the next one consumed."""
    counts, is_score = found.counts, isinstance(made, Score)
    is_taken = np.zeros(len(made.t_ns), np.bool_)
    had_begun = recorded.has_begun
    for block in recorded.until(int(made.t_ns[-1])):
        at = np.searchsorted(made.t_ns, block.t_ns)
        is_made = (at < len(made.t_ns)) & (made.t_ns[np.minimum(at, len(made.t_ns) - 1)] == block.t_ns)
        rows, within = at[is_made], block.t_ns[is_made] <= limit.t_ns
        is_taken[rows] = True
        if is_score:
            _count_not_made(block.t_ns[~is_made], found, limit)
        if block.fans != made.fans:
            different = np.ones(len(rows), np.bool_)
            found.name(f"{made.fans} fans replayed, {block.fans} recorded")
        else:
            different = _different_rows(made, rows, block, is_made, limit, found)
        counts["samples_different" if is_score else "others_different"] += int((different & within).sum())
        if is_score:
            found.add_not_comparable(int((different & ~within).sum()), limit)
            counts["samples_equal"] += int((~different).sum())
    if is_score:
        counts["samples_not_recorded"] += int((~is_taken).sum())
        taken = np.flatnonzero(is_taken)
        first, last = (int(taken[0]), int(taken[-1])) if len(taken) else (len(is_taken), 0)
        between = slice(0 if had_begun else first, len(is_taken) if recorded.has_more else last)
        found.holes += int((~is_taken & (made.t_ns <= limit.t_ns))[between].sum())


@cache
def _dtypes(kind: type[Message]) -> dict[str, np.dtype[Any]]:
    """The columns that are compared; optional ones are only passed on from the source."""
    return {
        name: column.dtype
        for name, column in columns(kind).items()
        if column.by_sample and not column.optional and name != "t_ns"
    }


def _different_rows(
    made: Samples, rows: Array, recorded: Samples, is_recorded: Array, limit: Limit, found: Comparison
) -> Array:
    """(n,) whether a sample differs; only those within the limit of their session are named."""
    t_ns = recorded.t_ns[is_recorded]
    within = t_ns <= limit.t_ns
    values = {
        name: (getattr(made, name)[rows].astype(dtype), getattr(recorded, name)[is_recorded].astype(dtype))
        for name, dtype in _dtypes(type(made)).items()
    }
    differ = {name: unequal(name, *both, found.note) for name, both in values.items()}
    number_differs = np.any([differs for name, differs in differ.items() if values[name][0].dtype.kind == "f"], axis=0)
    found.numbers_different += int((number_differs.any(axis=1) & within).sum())
    of_input = "" if isinstance(made, Score) else f"{_TOPICS[type(made)]}."
    for name, differs in differ.items():
        named = differs & within[:, np.newaxis]
        if named.any():
            row, fan = np.argwhere(named)[0].tolist()
            one, other = (each[row, fan] for each in values[name])
            found.name(
                f"{format_utc(int(t_ns[row]))}, fan {fan}: {of_input}{name} {one!s} replayed, {other!s} recorded "
                f"(in {int(named.any(axis=1).sum())} of {len(t_ns)} samples from here on)"
                f"{'' if number_differs[row, fan] else ', ' + AT_A_LIMIT}"
            )
    return np.any([differs.any(axis=1) for differs in differ.values()], axis=0)


def _count_not_made(t_ns: Array, found: Comparison, limit: Limit) -> None:
    """Count samples that were recorded and not replayed."""
    within = t_ns[t_ns <= limit.t_ns]
    found.add_not_comparable(len(t_ns) - len(within), limit)
    if len(within):
        found.counts["samples_not_made"] += len(within)
        found.name(f"{format_utc(int(within[0]))}: recorded and not replayed, {len(within)} samples")


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
    at_a_limit = f" ({AT_A_LIMIT})" if found.counts["samples_equal"] and not found.numbers_different else ""
    left = {_key(alarm): alarm for alarm in recorded}
    pairs: list[tuple[Alarm | None, Alarm | None]] = [(alarm, left.pop(_key(alarm), None)) for alarm in made]
    pairs += [(None, alarm) for alarm in left.values()]
    for one, other in pairs:
        alarm, difference = one or other, ""
        assert alarm
        described = f"alarm {alarm.transition.name.lower()} at {format_utc(alarm.t_ns)}, {alarm.message!r},"
        if one and other:
            if where := _alarm_difference(one, other, found.note):
                difference = f"replayed, {other.message!r} recorded: {where} differs"
        else:
            difference = f"{'replayed, none recorded' if one else 'recorded, none replayed'}{at_a_limit}"
        if not difference:
            result = "equal"
        elif alarm.t_ns > limit.t_ns:
            result = "not_comparable"
        elif other is None and alarm.t_ns >= last_scored_t_ns:
            result = "not_recorded"
        else:
            result = "different"
            found.name(f"{described} {difference}")
        found.counts[f"alarms_{result}"] += 1


def _key(alarm: Alarm) -> tuple[int, int, Transition, str]:
    return alarm.fan, alarm.t_ns, alarm.transition, alarm.request


def _alarm_difference(one: Alarm, other: Alarm, note: Callable[[Apart], None]) -> str:
    """The first field in which two alarms differ by more than the tolerance; empty if none."""
    mine, others = ({name: value for name, value in asdict(each).items() if name != "header"} for each in (one, other))
    return next(differences(mine, others, note), "")


def _blocks(envelopes: Iterable[Envelope], producer: str, kind: type[Samples]) -> Iterator[Samples]:
    payloads = (envelope.payload for envelope in _of_session(envelopes, producer))
    while waiting := list(islice(payloads, _BLOCK_MESSAGES)):
        yield from decode_together(kind, waiting)


def _of_session(envelopes: Iterable[Envelope], producer: str) -> Iterator[Envelope]:
    """The messages of one session, in order, each once: parts of a recording may overlap."""
    next_sequence = 0
    for envelope in envelopes:
        header = envelope.header
        if header.producer == producer and header.sequence >= next_sequence:
            next_sequence = header.sequence + 1
            yield envelope


class _RecordedSnapshots:
    """The recorded snapshots of one session of the scorer, compared in order with those of the replay.

    A scorer takes snapshots at the end of a block of samples. A replay has other blocks, so it takes its own at the
    samples of the recorded ones, and perhaps another at the same time for a request.
    """

    def __init__(self, recorded: Iterator[ScorerSnapshot], found: Comparison, limit: Callable[[], Limit]) -> None:
        self._recorded, self._found, self._limit = recorded, found, limit
        self._next = next(recorded, None)
        self._made: list[ScorerSnapshot] = []
        """those of one time"""

    def add(self, made: ScorerSnapshot) -> None:
        """Compare the next replayed snapshot."""
        if self._made and made.t_ns != self._made[0].t_ns:
            self.settle(made.t_ns)
        self._made.append(made)

    def settle(self, until_t_ns: int | None) -> None:
        """Compare the recorded snapshots before a time; None: all."""
        while self._next is not None and (until_t_ns is None or self._next.t_ns < until_t_ns):
            self._compare(self._next, [each for each in self._made if each.t_ns == self._next.t_ns])
            self._next = next(self._recorded, None)
        self._made = []

    def _compare(self, recorded: ScorerSnapshot, made: Sequence[ScorerSnapshot]) -> None:
        found = self._found
        places = [first_difference(each, recorded, found.note) for each in made]
        if "" in places:
            result = "equal"
        elif recorded.t_ns > self._limit().t_ns:
            result = "not_comparable"
        else:
            result = "different"
            what = f"{places[-1]} differs" if places else "recorded and not replayed"
            found.name(f"snapshot of {format_utc(recorded.t_ns)}: {what}")
        found.counts[f"snapshots_{result}"] += 1


def first_difference(
    made: ScorerSnapshot, recorded: ScorerSnapshot, note: Callable[[Apart], None] = lambda _apart: None
) -> str:
    """The first place in which two snapshots differ by more than the tolerance; empty if none.

    note: see `unequal`.
    """
    if made.twin_sha256 != recorded.twin_sha256:
        return "twin_sha256"
    if made.state_json == recorded.state_json:
        return ""
    try:
        one, other = (_state(snapshot) for snapshot in (made, recorded))
    except (ValueError, LookupError, TypeError, AttributeError):
        return "state_json"
    return next(differences(one, other, note), "")


def _state(snapshot: ScorerSnapshot) -> dict[str, Any]:
    """What a snapshot holds, with its arrays as such."""
    state = json.loads(snapshot.state_json)
    return state | {"arrays": from_json(state["arrays"])}


def _saved(envelopes: Iterable[Envelope], producer: str) -> Iterator[ScorerSnapshot]:
    """The snapshots that a session saved. What cannot be decoded is reported with the plan."""

    def decodable() -> Iterator[Envelope]:
        for envelope in envelopes:
            with suppress(CodecError):
                _ = envelope.message
                yield envelope

    saved = (envelope.message for envelope in _of_session(decodable(), producer))
    return (message for message in saved if isinstance(message, ScorerSnapshot) and not message.restored)
