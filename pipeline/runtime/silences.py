"""Distinguishes a producer that sends nothing from a link that may be cut.

A running stage publishes health each second, with the number of messages that it has published. A consumer that has
received as many knows that no more were sent until then, unless input of the tray waits in the producer. Without such a
health, the producer may be keeping messages that arrive when the link is back.

Three kinds of health show no silence. One that arrived late, because the link was cut meanwhile, does not cover the
time since it was sent. A producer in which input of the tray waits may still publish. A session that has just begun and
has published nothing may still be reading what its device has kept.

Where two sessions have a tray, only the health of its owner counts: the other says nothing about what the owner keeps.

After a session that has ended with an error, or was killed, the consumer waits `RESTART_S` for the next session, which
reads what the device has kept meanwhile.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial

from fantwin.pipeline.runtime.sessions import Sessions
from fantwin.schemas.enums import StageStatus
from fantwin.schemas.health import Health
from fantwin.schemas.streams import StreamId
from fantwin.schemas.units import NS_PER_S

BEGINS_NS = 5 * NS_PER_S
"""this long after its first health that is not STARTING, a session has read what its device had kept"""
MOST_DELAY_S = 0.4
"""a health message that took this much longer to arrive than the fastest of the last ones is late; less than a
resampler waits"""
MOST_HEARD = 8
"""producers of a tray whose earlier health is remembered"""
_DELAYS = 16
"""number of the last health messages that are compared; after as many, a step of a host clock no longer matters"""
RESTART_S = 5.0
"""how long the next session is awaited after the end of one that did not end in order"""


@dataclass(frozen=True, slots=True)
class _Ended:
    """The end of a session. has_all: whether all that it sent has arrived. at_s: when the end counts, monotonic
    time."""

    has_all: Callable[[], bool]
    at_s: float


@dataclass(slots=True)
class _Heard:
    """The earlier health of a producer. begun_t_ns: time of its first health after its start, ns. ages_s: of its last
    health messages on arrival, plus an unknown constant, because clocks differ."""

    begun_t_ns: int
    ages_s: deque[float] = field(default_factory=lambda: deque(maxlen=_DELAYS))


class Silences:
    """The silences of the producers of a stage's main inputs."""

    def __init__(
        self, trays: Mapping[str, str], sessions: Sessions, now_s: Callable[[], float] = time.monotonic
    ) -> None:
        """trays: the tray of each key of the main input. sessions: those on the bus."""
        self._trays = trays
        self._sessions = sessions
        self._now_s = now_s
        self._reporting: dict[str, tuple[str, Callable[[], bool]]] = {}
        """by tray whose producer publishes health, and has not ended with all that it sent: the producer, and whether
        what it has reported has arrived"""
        self._ended: dict[str, _Ended] = {}
        """by tray whose producer has ended"""
        self._unordered_s: dict[str, float] = {}
        """by tray: monotonic time, s, of the first end not in order since a producer last published"""
        self._heard: dict[str, dict[str, _Heard]] = {}
        """by tray and producer"""
        self._shown: set[str] = set()

    def add_health(self, health: Health, has_all_of: Callable[[StreamId, int], bool]) -> None:
        """A stage reports how many messages it has published. has_all_of: whether a stream has arrived up to a
        number."""
        producer = health.header.producer
        for output in health.outputs:
            tray, published = self._trays.get(output.key), output.published
            if tray is None or not self._is_of_owner(health, output.key, tray):
                continue
            has_all = partial(has_all_of, (output.key, producer), published)
            self._reporting[tray] = producer, has_all
            if health.is_last:
                self._end(tray, is_in_order=health.status == StageStatus.STOPPED)
                continue
            self._ended.pop(tray, None)
            if published:
                self._unordered_s.pop(tray, None)
            heard = self._heard_of(tray, health)
            is_late = self._is_late(heard, health)
            has_begun = bool(published) or health.t_ns - heard.begun_t_ns >= BEGINS_NS
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

    def _is_of_owner(self, health: Health, key: str, tray: str) -> bool:
        """Whether a health message is of the session that owns the tray in its stage; where there is none, of any
        producer that is no stranger on this key."""
        owner = self._sessions.owner(health.stage, tray)
        if owner is not None:
            return owner.producer == health.header.producer
        return not self._sessions.is_stranger(key, health.header.producer)

    def _heard_of(self, tray: str, health: Health) -> _Heard:
        """What is remembered of the producer of a health message; while it is starting, it begins with this one."""
        of_tray, producer = self._heard.setdefault(tray, {}), health.header.producer
        if producer not in of_tray:
            of_tray[producer] = _Heard(health.t_ns)
            if len(of_tray) > MOST_HEARD:
                del of_tray[next(iter(of_tray))]
        elif health.status == StageStatus.STARTING:
            of_tray[producer].begun_t_ns = health.t_ns
        return of_tray[producer]

    def _is_late(self, heard: _Heard, health: Health) -> bool:
        heard.ages_s.append(self._now_s() - health.t_ns / NS_PER_S)
        return heard.ages_s[-1] - min(heard.ages_s) > MOST_DELAY_S
