"""Distinguishes a producer that sends nothing from a link that may be cut.

A running stage publishes health each second, with the number of messages that it has published. A consumer that has
received as many knows that no more were sent until then, unless input of the tray waits in the producer. Without such a
health, the producer may be keeping messages that arrive when the link is back.

Three kinds of health show no silence. One that arrived late, because the link was cut meanwhile, does not cover the
time since it was sent. A producer in which input of the tray waits may still publish. A session that has just begun and
has published nothing may still be reading what its device has kept.

After a session that has ended with an error, or was killed, the consumer waits `RESTART_S` for the next session, which
reads what the device has kept meanwhile.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial

from schemas.enums import StageStatus
from schemas.health import Health
from schemas.streams import StreamId
from schemas.units import NS_PER_S

BEGINS_NS = 5 * NS_PER_S
"""this long after its first health that is not STARTING, a session has read what its device had kept"""
MOST_DELAY_S = 0.4
"""a health that took this much longer to arrive than the fastest of the last ones is late; less than a resampler
waits"""
_DELAYS = 16
"""number of the last healths that are compared; after as many, a step of a host clock no longer matters"""
RESTART_S = 5.0
"""how long the next session is awaited after the end of one that did not end in order"""


@dataclass(frozen=True, slots=True)
class _Ended:
    """The end of a session. has_all: whether all that it sent has arrived. at_s: when the end counts, monotonic
    time."""

    has_all: Callable[[], bool]
    at_s: float


class Silences:
    """The silences of the producers of a stage's main inputs."""

    def __init__(self, trays: Mapping[str, str], now_s: Callable[[], float] = time.monotonic) -> None:
        """trays: the tray of each key of the main input."""
        self._trays = trays
        self._now_s = now_s
        self._reporting: dict[str, tuple[str, Callable[[], bool]]] = {}
        """by tray whose producer publishes health, and has not ended with all that it sent: the producer, and whether
        what it has reported has arrived"""
        self._ended: dict[str, _Ended] = {}
        """by tray whose producer has ended"""
        self._unordered_s: dict[str, float] = {}
        """by tray: when a producer first ended not in order since one last published, monotonic time"""
        self._begun: dict[str, tuple[str, int]] = {}
        """by tray: a producer that has published nothing, and the time of its first health after its start, ns"""
        self._ages_s: dict[str, tuple[str, deque[float]]] = {}
        """by tray: a producer, and the ages of its last healths on arrival, plus an unknown constant, because clocks
        differ"""
        self._shown: set[str] = set()

    def add_health(self, health: Health, has_all_of: Callable[[StreamId, int], bool]) -> None:
        """A stage reports how many messages it has published. has_all_of: whether a stream has arrived up to a
        number."""
        producer = health.header.producer
        for output in health.outputs:
            tray, published = self._trays.get(output.key), output.published
            if tray is None:
                continue
            has_all = partial(has_all_of, (output.key, producer), published)
            self._reporting[tray] = producer, has_all
            if health.has_ended:
                self._end(tray, is_in_order=health.status == StageStatus.STOPPED)
                continue
            self._ended.pop(tray, None)
            if published:
                self._unordered_s.pop(tray, None)
            is_late, has_begun = self._is_late(tray, health), bool(published) or self._has_begun(tray, health)
            if has_begun and has_all() and not (is_late or output.has_more):
                self._shown.add(tray)

    def end(self, producer: str) -> None:
        """This producer was killed: it sends no more."""
        for tray, (its_producer, _) in self._reporting.items():
            if its_producer == producer and tray not in self._ended:
                self._end(tray, is_in_order=False)

    def take(self, tray: str) -> bool:
        """Whether the tray's producer has shown, since the last call, that there is no more; True also for a producer
        that never shows it."""
        ended = self._ended.get(tray)
        if ended and self._now_s() >= ended.at_s and ended.has_all():
            del self._reporting[tray], self._ended[tray]
        is_shown = tray in self._shown
        self._shown.discard(tray)
        return is_shown or tray not in self._reporting

    def _end(self, tray: str, *, is_in_order: bool) -> None:
        now_s = self._now_s()
        at_s = now_s if is_in_order else self._unordered_s.setdefault(tray, now_s) + RESTART_S
        self._ended[tray] = _Ended(self._reporting[tray][1], at_s)

    def _is_late(self, tray: str, health: Health) -> bool:
        producer, ages_s = self._ages_s.get(tray, ("", deque[float]()))
        if producer != health.header.producer:
            ages_s = deque(maxlen=_DELAYS)
            self._ages_s[tray] = health.header.producer, ages_s
        ages_s.append(self._now_s() - health.t_ns / NS_PER_S)
        return ages_s[-1] - min(ages_s) > MOST_DELAY_S

    def _has_begun(self, tray: str, health: Health) -> bool:
        """Whether a session that has published nothing has run for `BEGINS_NS` since its start."""
        producer = health.header.producer
        if health.status == StageStatus.STARTING or self._begun.get(tray, ("", 0))[0] != producer:
            self._begun[tray] = producer, health.t_ns
        return health.t_ns - self._begun[tray][1] >= BEGINS_NS
