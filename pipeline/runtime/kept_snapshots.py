"""The last message about each tray that a stage keeps for others: what a stage continues from where its own file is
missing or old.

The recorder keeps the last snapshot of each of its trays. So a scorer that is killed with its host goes on elsewhere.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterable, Mapping

from pipeline.bus.session import Bus
from pipeline.config.registry import STAGES
from pipeline.runtime.second_owner import GOSSIP_S
from pipeline.runtime.sessions import Session
from schemas.codec import CodecError, decode
from schemas.envelope import Envelope
from schemas.messages import ScorerSnapshot
from schemas.topics import sessions_key, topic_of, tray_key

SNAPSHOT = "snapshot"
IMPATIENT_S = 0.5
"""how long further answers are waited for, once one has not come in time"""
_POLL_S = 0.05


class KeptForOthers:
    """The last messages that this process keeps."""

    def __init__(self, bus: Bus, site: str, topics: Iterable[str], producer: str, before: Mapping[str, bytes]) -> None:
        """topics: those that are kept; producer: of this process; before: messages from before its start, by key."""
        self._topics = {topic: bus.keep(tray_key(site, "*", topic), producer) for topic in topics}
        for key, payload in before.items():
            self._topics[topic_of(key).name].put(key, payload)

    def add(self, envelope: Envelope) -> None:
        """Keep a message if it is of such a topic."""
        if envelope.topic in self._topics:
            self._topics[envelope.topic].put(envelope.key, envelope.payload)


class KeptSnapshots:
    """Asks the stages of a site for the snapshots that they keep."""

    def __init__(self, bus: Bus, site: str, stop: threading.Event, timeout_s: float, *, is_one_expected: bool) -> None:
        """timeout_s: how long to wait for an answer, and for a stage that keeps snapshots to appear; is_one_expected:
        whether the configuration has one."""
        self._bus = bus
        self._site = site
        self._stop = stop
        self._timeout_s = timeout_s
        self._is_one_expected = is_one_expected
        self._began_s: float | None = None

    def of(self, tray: str, *, is_patient: bool) -> list[ScorerSnapshot]:
        """The last snapshot of a tray that each stage keeps. is_patient: wait for a stage that is not there yet."""
        if self._began_s is None:
            self._bus.wait_for_others(self._stop)
            self._began_s = time.monotonic()
        self._wait_for_one(tray, self._began_s + self._limit_s(is_patient))
        payloads, have_answered = self._bus.ask_for_kept(tray_key(self._site, tray, SNAPSHOT), self._timeout_s)
        if not have_answered:
            self._timeout_s = min(self._timeout_s, IMPATIENT_S)
        return [snapshot for snapshot in map(_decoded, payloads) if snapshot is not None]

    def _limit_s(self, is_patient: bool) -> float:
        """How long to wait for a stage: until the first process met has introduced it, or until it has started."""
        if is_patient and self._is_one_expected:
            return self._timeout_s
        return GOSSIP_S if self._bus.came_second else 0.0

    def _wait_for_one(self, tray: str, until_s: float) -> None:
        while not self._is_kept(tray) and time.monotonic() < until_s:
            if self._stop.wait(_POLL_S):
                return

    def _is_kept(self, tray: str) -> bool:
        sessions = map(Session.of_key, self._bus.alive(sessions_key(self._site)))
        return any(each is not None and keeps_snapshots(each.stage) and each.has(tray) for each in sessions)


def keeps_snapshots(stage: str) -> bool:
    """Whether a stage keeps the snapshots of others."""
    return stage in STAGES and SNAPSHOT in STAGES[stage].keeps


def _decoded(payload: bytes) -> ScorerSnapshot | None:
    try:
        return decode(ScorerSnapshot, payload)
    except CodecError:
        return None
