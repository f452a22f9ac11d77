"""Comparing replayed snapshots of a scorer with the recorded ones: where scores are not recorded, they show that every
statistic and alarm was the same, and all that was learned of the fans.

A scorer takes snapshots at the end of a block of samples. A replay has other blocks, so it takes its own at the samples
of the recorded ones.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

from fantwin.pipeline.recordings.dates import format_utc
from fantwin.pipeline.replay.offline.comparison import Comparison
from fantwin.pipeline.replay.offline.plan import Limit, Session
from fantwin.pipeline.replay.offline.tolerance import Apart, differences
from fantwin.schemas.codec import CodecError
from fantwin.schemas.envelope import Envelope
from fantwin.schemas.messages import ScorerSnapshot
from fantwin.scoring.model.saved import from_json


class SnapshotVerifier:
    """Compares what a replay of one tray makes, session by session, in order."""

    def __init__(
        self, read: Callable[[], Iterable[Envelope]], limit_of: Callable[[str], Limit], found: Comparison
    ) -> None:
        """read: the recorded snapshots of the tray, from the beginning at each call. limit_of: the limit of a session
        of the scorer. found: takes the results."""
        self._read = read
        self._limit_of = limit_of
        self._found = found
        self._producer: str | None = None
        self._recorded: Iterator[ScorerSnapshot] = iter(())
        self._next: ScorerSnapshot | None = None
        self._made: list[ScorerSnapshot] = []
        """those of one time: a request is answered between two samples"""
        self._visited: set[str] = set()

    def add(self, producer: str, made: ScorerSnapshot) -> None:
        """Compare the next replayed snapshot, of the recorded session `producer`."""
        if producer != self._producer:
            self._begin_session(producer)
        if self._made and made.t_ns != self._made[0].t_ns:
            self._settle(made.t_ns)
        self._made.append(made)

    def finish(self, sessions: Sequence[Session]) -> None:
        """Compare what is left."""
        for session in sessions:
            if session.producer not in self._visited:
                self._begin_session(session.producer)
        self._settle(None)

    def _begin_session(self, producer: str) -> None:
        self._settle(None)
        self._producer = producer
        self._visited.add(producer)
        self._recorded = _saved(self._read(), producer)
        self._next = next(self._recorded, None)

    def _settle(self, until_t_ns: int | None) -> None:
        """Compare the recorded snapshots before a time; None: all."""
        while self._next is not None and (until_t_ns is None or self._next.t_ns < until_t_ns):
            made = [each for each in self._made if each.t_ns == self._next.t_ns]
            self._compare(self._next, made)
            self._next = next(self._recorded, None)
        self._made = []

    def _compare(self, recorded: ScorerSnapshot, made: Sequence[ScorerSnapshot]) -> None:
        found = self._found
        places = [first_difference(each, recorded, found.note) for each in made]
        if "" in places:
            found.snapshots_equal += 1
            return
        limit = self._limit_of(self._producer or "")
        at = f"{found.tray}: snapshot of {format_utc(recorded.t_ns)}"
        if recorded.t_ns > limit.t_ns:
            found.snapshots_not_comparable += 1
        elif not places:
            found.snapshots_different += 1
            found.name(f"{at}: recorded and not replayed")
        else:
            found.snapshots_different += 1
            found.name(f"{at}: {places[-1]} differs")


def first_difference(
    made: ScorerSnapshot, recorded: ScorerSnapshot, note: Callable[[Apart], None] = lambda _apart: None
) -> str:
    """The first place in which two snapshots differ by more than the tolerance; empty if none.

    note: see `tolerance.differences`.
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
    model = state["model"]
    return state | {"model": model | {"arrays": from_json(model["arrays"])}}


def _saved(envelopes: Iterable[Envelope], producer: str) -> Iterator[ScorerSnapshot]:
    """The snapshots that a session saved, in order, each once. What cannot be decoded is reported with the plan."""
    next_sequence = 0
    for envelope in envelopes:
        try:
            message = envelope.message
        except CodecError:
            continue
        header = message.header
        if isinstance(message, ScorerSnapshot) and header.producer == producer and header.sequence >= next_sequence:
            next_sequence = header.sequence + 1
            if not message.restored:
                yield message
