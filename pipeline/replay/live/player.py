"""Plays a recording: each message when it is due, keys in between, and twenty times a second what time it is."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

from pipeline.replay.live.keyboard import Key
from pipeline.replay.live.pace import Pace, faster, slower
from schemas.envelope import Envelope
from schemas.messages import Raw, StageStatus
from schemas.topics import TOPICS

BEAT_S = 0.05
HEALTH_PERIOD_S = 1.0
_RANK = {topic.name: rank for rank, topic in enumerate(TOPICS)}


class Stopped(Exception):  # noqa: N818  it is no error
    """Somebody asked for the end."""


class Time(Protocol):
    """The clock of this process, and how to wait by it."""

    def now_s(self) -> float:
        """Monotonic seconds."""
        ...

    def wait(self, for_s: float) -> bool:
        """Wait; true, and at once, when the end is asked for."""
        ...


class RealTime:
    """Waits on an event that a signal sets."""

    def __init__(self, stop: threading.Event) -> None:
        self._stop = stop

    def now_s(self) -> float:
        """Monotonic seconds."""
        return time.monotonic()

    def wait(self, for_s: float) -> bool:
        """Wait; true, and at once, when the end is asked for."""
        return self._stop.wait(for_s) if for_s > 0.0 else self._stop.is_set()


class Output(Protocol):
    """Where the messages go; see `pipeline.replay.live.sender`."""

    def send(self, entry: Envelope) -> None: ...  # noqa: D102
    def tell_clock(self, t_ns: int, rate: float) -> None: ...  # noqa: D102
    def tell_health(self, status: StageStatus = ..., problem: str = ...) -> None: ...  # noqa: D102
    def published(self) -> Mapping[str, int]: ...  # noqa: D102


@dataclass(frozen=True)
class Progress:
    """Where a replay has come to."""

    t_ns: int
    rate: float
    paused: bool
    round: int
    messages: int


class Player:
    """One replay."""

    def __init__(
        self,
        output: Output,
        pace: Pace,
        clock: Time,
        *,
        keys: Callable[[], Sequence[Key]] = tuple,
        look: Callable[[Progress], None] = lambda _progress: None,
    ) -> None:
        """`keys` gives those pressed since it was asked last; `look` is called about every 50 ms, and may raise."""
        self._output = output
        self._pace = pace
        self._clock = clock
        self._keys = keys
        self._look = look
        self._next_beat_s = self._next_health_s = 0.0
        self._steps = 0
        self._leading = len(_RANK)
        self._round = 0
        self._messages = 0
        self._told_ns = 0
        self.first_ns = self.last_ns = 0
        """from when to when it was played, in recorded time"""
        self.began_s = self.ended_s = clock.now_s()
        """the same by this process's clock"""

    def play(self, rounds: Iterable[tuple[int, Envelope]]) -> None:
        """Play to the end.

        Raises:
            Stopped: the end was asked for before.
        """
        try:
            for self._round, entry in rounds:
                if not self._messages:
                    self._begin(entry)
                self._wait_for(entry)
                self._output.send(entry)
                self._messages += 1
                self.last_ns = max(self.last_ns, entry.received_t_ns)
                self._note_step(entry)
        finally:
            self.ended_s = self._clock.now_s()
            self._pace.change(self.last_ns, self.ended_s)  # a last pause counts, too
        self._output.tell_health()  # at once: how much has been sent in all

    def linger(self) -> None:
        """Go on saying what time it is and how it is, after the end."""
        if self._clock.now_s() >= self._next_beat_s:
            self._beat(self._clock.now_s(), self.last_ns, self.last_ns)

    def _begin(self, entry: Envelope) -> None:
        self.began_s = self._clock.now_s()
        self.first_ns = self.last_ns = entry.received_t_ns
        self._pace.start(entry.received_t_ns, self.began_s)

    def _wait_for(self, entry: Envelope) -> None:
        """Return when the message is due."""
        while True:
            now_s = self._clock.now_s()
            if now_s >= self._next_beat_s:
                self._press(entry, now_s)
                self._beat(now_s, self._pace.position_ns(now_s, entry.received_t_ns), _no_later(entry))
            wait_s = 0.0 if self._steps else self._pace.due_in_s(entry.received_t_ns, now_s)
            if self._clock.wait(min(max(wait_s, 0.0), BEAT_S)):
                raise Stopped
            if wait_s <= 0.0:
                return

    def _beat(self, now_s: float, position_ns: int, no_later_ns: int) -> None:
        self._next_beat_s = now_s + BEAT_S
        # samples that are still to come are not late: the clock waits before them
        self._told_ns = max(self._told_ns, min(position_ns, no_later_ns))
        self._output.tell_clock(self._told_ns, self._pace.rate_now)
        if now_s >= self._next_health_s:
            self._next_health_s = now_s + HEALTH_PERIOD_S
            self._output.tell_health()
        self._look(Progress(position_ns, self._pace.rate, self._pace.paused, self._round, self._messages))

    def _press(self, entry: Envelope, now_s: float) -> None:
        """Do what the keys ask for."""
        for key in self._keys():
            at_ns = self._pace.position_ns(now_s, entry.received_t_ns)
            match key:
                case Key.PAUSE:
                    self._pace.change(at_ns, now_s, paused=not self._pace.paused)
                case Key.STEP:
                    self._pace.change(at_ns, now_s, paused=True)
                    self._steps += 1
                case Key.FASTER:
                    self._pace.change(at_ns, now_s, rate=faster(self._pace.rate))
                case Key.SLOWER:
                    self._pace.change(at_ns, now_s, rate=slower(self._pace.rate))
                case Key.QUIT:
                    raise Stopped

    def _note_step(self, entry: Envelope) -> None:
        """A step ends with a message of the first topic there is: with the next sample, and all recorded before it."""
        self._leading = min(self._leading, _RANK[entry.topic])
        if self._steps and _RANK[entry.topic] == self._leading:
            self._steps -= 1
            self._pace.change(entry.received_t_ns, self._clock.now_s(), paused=True)
            self._next_beat_s = self._clock.now_s()  # to be seen at once


def _no_later(entry: Envelope) -> int:
    """The time of its oldest raw sample, or its own."""
    message = entry.message
    if isinstance(message, Raw) and len(message.host_receive_t_ns):
        return int(message.host_receive_t_ns[0])
    return entry.received_t_ns
