"""Snapshots that a stage keeps for others, the last one of each tray. A stage whose own file is missing or old
continues from them.

The recorder keeps the last snapshot of each of its trays. So a scorer that is killed with its host goes on elsewhere.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass

from fantwin.pipeline.bus.kept_messages import KeptQuery
from fantwin.pipeline.bus.session import Bus
from fantwin.pipeline.config.registry import STAGES
from fantwin.pipeline.runtime.second_owner import GOSSIP_S
from fantwin.schemas.codec import CodecError, decode
from fantwin.schemas.envelope import Envelope
from fantwin.schemas.messages import ScorerSnapshot
from fantwin.schemas.topics import tray_key

SNAPSHOT = "snapshot"
KEEPER_LIMIT_S = 60.0
"""how long a stage without a recent file waits for one that keeps snapshots; what it misses meanwhile, others keep"""
IMPATIENT_S = 0.5
"""how long further answers are waited for, once one has not come in time"""
_POLL_S = 0.05


class KeptForOthers:
    """The last messages that this process keeps."""

    def __init__(
        self,
        bus: Bus,
        site: str,
        topics: Iterable[str],
        trays: Iterable[str],
        before: Mapping[str, bytes],
        on_query: Callable[[KeptQuery], object],
    ) -> None:
        """topics, trays: those of which messages are kept. before: messages from before its start, by key.

        on_query: called from a thread of the bus. `answer` must be called after what had arrived before the query has
        been added: whoever asks has seen the end of a process, whose last message may still be on the way.
        """
        self._topics = frozenset(topics)
        self._keys = {tray_key(site, tray, topic) for tray in trays for topic in self._topics}
        self._last = dict(before)
        for topic in self._topics:
            bus.answer_for_kept(tray_key(site, "*", topic), on_query)

    def add(self, envelope: Envelope) -> None:
        """Keep a message if it is of such a topic."""
        if envelope.topic in self._topics:
            self._last[envelope.key] = envelope.payload

    def answer(self, query: KeptQuery) -> None:
        """Give the last message to whoever asks for it."""
        if query.key in self._keys:
            query.answer(self._last.get(query.key, b""))
        else:
            query.decline()


@dataclass
class KeptSnapshots:
    """Asks the stages of a site for the snapshots that they keep.

    Attributes:
        bus: joins it, if it is not joined yet.
        wait_for_predecessor: returns when no other process has these trays, so that no snapshot is still to come.
        answer_limit_s: how long to wait for an answer.
        is_one_expected: whether the configuration has a stage that keeps snapshots; if so, it is waited for up to
            keeper_limit_s.
    """

    bus: Callable[[], Bus]
    site: str
    stop: threading.Event
    wait_for_predecessor: Callable[[], None]
    answer_limit_s: float
    _: KW_ONLY
    is_one_expected: bool
    keeper_limit_s: float = KEEPER_LIMIT_S
    _began_s: float | None = None

    def of(self, tray: str, *, is_patient: bool) -> tuple[Sequence[ScorerSnapshot], str]:
        """The last snapshot of a tray that each stage keeps, and why there may be others, for people. is_patient: wait
        for a stage that is not there yet.

        Raises:
            StageError: another process has the tray.
        """
        if self._began_s is None:
            self.wait_for_predecessor()
            self._began_s = time.monotonic()
        is_patient = is_patient and self.is_one_expected
        bus, key = self.bus(), tray_key(self.site, tray, SNAPSHOT)
        limit_s = self.keeper_limit_s if is_patient else GOSSIP_S if bus.came_second else 0.0
        while True:
            payloads, have_answered = bus.ask_for_kept(key, self.answer_limit_s)
            is_over = time.monotonic() >= self._began_s + limit_s
            if payloads or is_over or not have_answered or self.stop.wait(_POLL_S):
                break
        why = f"no recorder of this tray was there within {limit_s:g} s" if is_patient and not payloads else ""
        if not have_answered:
            why = f"a recorder did not answer within {self.answer_limit_s:g} s"
            self.answer_limit_s = min(self.answer_limit_s, IMPATIENT_S)
        return [snapshot for snapshot in map(_decoded, payloads) if snapshot is not None], why


def keeps_snapshots(stage: str) -> bool:
    """Whether a stage keeps the snapshots of others."""
    return stage in STAGES and SNAPSHOT in STAGES[stage].keeps


def _decoded(payload: bytes) -> ScorerSnapshot | None:
    try:
        return decode(ScorerSnapshot, payload) if payload else None
    except CodecError:
        return None
