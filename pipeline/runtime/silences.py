"""Whether nothing comes because nothing is sent, or because the link to the producer may be cut.

A stage that works publishes health each second, with the number of messages that it has published. So a consumer that
has as many knows that there was no more until then, unless the producer says that it has not processed all of its
input. Without that, a silence says nothing: what was sent may be kept by its producer, and come when the link is there
again.

A health that was long on its way, because the link was cut meanwhile, says nothing of the time since it was sent.

A session that has just begun may still read what its device has kept, so its first healths show nothing before its
first message. After a session that has ended with an error, or was killed, the next one is waited for, which reads what
the device keeps meanwhile.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial

from schemas.enums import StageStatus
from schemas.health import Health
from schemas.streams import StreamId, output_streams
from schemas.units import NS_PER_S

BEGINS_NS = 5 * NS_PER_S
"""so long after its start has been reported, a session without a message has read what its device had kept"""
MOST_DELAY_S = 0.4
"""a health that was so much longer on its way than others came late: less than a resampler waits at least"""
_DELAYS = 16
"""so many of the last healths are compared: it takes as long until a clock that was set does not matter any more"""
RESTART_S = 5.0
"""how long after the end of a session that did not end in order the next one is waited for"""


@dataclass(frozen=True, slots=True)
class _Ended:
    """The end of a session; at_s: when it counts, monotonic."""

    has_all: Callable[[], bool]
    at_s: float


class Silences:
    """Of the main inputs of a stage."""

    def __init__(self, trays: Mapping[str, str], now_s: Callable[[], float] = time.monotonic) -> None:
        """trays: that of each key of the main input."""
        self._trays = trays
        self._now_s = now_s
        self._reporting: dict[str, tuple[str, Callable[[], bool]]] = {}
        """by tray whose producer publishes health, and has not ended with all that it sent: the producer, and whether
        what it has reported has arrived"""
        self._ended: dict[str, _Ended] = {}
        """by tray whose producer has ended"""
        self._unordered_s: dict[str, float] = {}
        """by tray: when its producer ended not in order, the first time since it sent something"""
        self._begun: dict[str, tuple[str, int]] = {}
        """by tray: a producer without a message, and the time of its first health after its start, ns"""
        self._ages_s: dict[str, tuple[str, deque[float]]] = {}
        """by tray: a producer, and the ages of its last healths when they came, plus a constant: clocks differ"""
        self._shown: set[str] = set()

    def add_health(self, health: Health, has_all_of: Callable[[StreamId, int], bool]) -> None:
        """A stage says how many messages it has published; has_all_of: whether a stream has arrived up to a number."""
        producer = health.header.producer
        for stream, published in output_streams(health).items():
            tray = self._trays.get(stream[0])
            if tray is None:
                continue
            has_all = partial(has_all_of, stream, published)
            self._reporting[tray] = producer, has_all
            if health.has_ended:
                self._end(tray, is_in_order=health.status == StageStatus.STOPPED)
                continue
            self._ended.pop(tray, None)
            if published:
                self._unordered_s.pop(tray, None)
            is_late, has_begun = self._is_late(tray, health), bool(published) or self._has_begun(tray, health)
            if has_begun and has_all() and not (is_late or health.has_unprocessed):
                self._shown.add(tray)

    def end(self, producer: str) -> None:
        """This producer was killed: what has not left it does not come any more."""
        for tray, (its_producer, _) in self._reporting.items():
            if its_producer == producer and tray not in self._ended:
                self._end(tray, is_in_order=False)

    def take(self, tray: str) -> bool:
        """Whether its producer has shown, since this was last asked, that there is no more; True also for a producer
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
        """Whether a session has been at work for a while, though it has published nothing."""
        producer = health.header.producer
        if health.status == StageStatus.STARTING or self._begun.get(tray, ("", 0))[0] != producer:
            self._begun[tray] = producer, health.t_ns
        return health.t_ns - self._begun[tray][1] >= BEGINS_NS
