"""The streams that a stage remembers: a bounded number, however many producers publish, and however much."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from itertools import islice

from fantwin.pipeline.runtime.sessions import Sessions
from fantwin.schemas.envelope import Envelope
from fantwin.schemas.health import Input
from fantwin.schemas.streams import StreamId, StreamState
from fantwin.schemas.topics import HEALTH_CHUNK, health_key

MOST_PRODUCERS = 64
"""of one key are remembered. Every `fantwin alarms ack` is a producer of its own."""
MOST_HEALTH_PRODUCERS = 1024
"""of all health keys of a site together"""
SILENT_S = 60.0
"""a producer that has not been heard for so long makes room for another first"""


@dataclass(frozen=True, eq=False, slots=True)
class Request:
    """Messages `first..last` of a producer on a key are missing; producer `*`: those of all producers.

    not_before_s: when it is sent, monotonic; 0: at once.
    """

    key: str
    producer: str
    first: int
    last: int
    not_before_s: float = 0.0


@dataclass(slots=True)
class Waiting:
    """A stream waits for the missing messages before number `until`.

    Attributes:
        shown_by: the message that showed the gap; None: a health message did.
        since_s: when the first of these messages were asked for, or the last ones came, monotonic.
        held: what has arrived since.
    """

    request: Request
    until: int
    shown_by: Envelope | None
    since_s: float
    held: deque[Envelope] = field(default_factory=deque)
    held_bytes: int = 0

    def hold(self, envelope: Envelope) -> None:
        """Keep a message until the missing ones have come."""
        self.held.append(envelope)
        self.held_bytes += len(envelope.payload)


@dataclass(slots=True)
class Stream(StreamState):
    """A stream and what the tracker needs to know about it. `heard_s`: when it was last heard, monotonic."""

    key: str = ""
    producer: str = ""
    heard_s: float = 0.0
    waiting: Waiting | None = None


class TrackedStreams:
    """Streams by key and producer.

    To make room for a new stream, one that has been silent for long is forgotten, or else the one that has sent least.
    Its counts are added up under an empty name. A stream that waits for missing messages is not forgotten; while all
    wait, a new one is refused. A new producer that is not a session of a stage is also refused in a flood (as many new
    ones within SILENT_S as are remembered). On a key that a session publishes, strangers are refused, new or not.
    """

    def __init__(self, now_s: Callable[[], float], sessions: Sessions) -> None:
        self._now_s = now_s
        self._sessions = sessions
        self._newcomers_s: dict[str, deque[float]] = {}
        """by group: when the last new producers were first heard"""
        self._groups: dict[str, dict[StreamId, Stream]] = {}
        """by key, one for all keys of health; the stream heard last is at the end"""
        self._forgotten: dict[str, StreamState] = {}

    def __iter__(self) -> Iterator[Stream]:
        """All streams that are remembered."""
        return (stream for group in self._groups.values() for stream in group.values())

    def get(self, key: str, producer: str) -> Stream | None:
        """A stream that is remembered; None if it is not."""
        return self._groups.get(_group(key), {}).get((key, producer))

    def heard(self, key: str, producer: str) -> Stream | None:
        """The stream, which is heard now; a new one if it is not remembered. None: it is refused."""
        if self._sessions.is_stranger(key, producer):
            return None
        name = _group(key)
        group = self._groups.setdefault(name, {})
        stream = group.pop((key, producer), None)
        if stream is None:
            most = MOST_PRODUCERS if name == key else MOST_HEALTH_PRODUCERS
            newcomers_s, now_s = self._newcomers_s.setdefault(name, deque(maxlen=most)), self._now_s()
            is_flood = len(newcomers_s) == most and now_s - newcomers_s[0] < SILENT_S
            if (is_flood and not self._sessions.is_alive(producer)) or (
                len(group) >= most and not self._forget_one(name)
            ):
                return None
            newcomers_s.append(now_s)
            stream = Stream(key=key, producer=producer, heard_s=now_s)
        group[key, producer] = stream
        return stream

    def inputs(self, unsaved: Iterable[Envelope] = ()) -> tuple[Input, ...]:
        """The counts for health; those of forgotten streams are the last of their key, without a producer.

        unsaved: the messages that are lost if the stage is killed now.
        """
        at_risk = Counter((envelope.key, envelope.header.producer) for envelope in unsaved)
        found: list[Input] = []
        for name, group in self._groups.items():
            found += [
                stream.as_input(id, at_risk[id]) for id, stream in group.items() if stream.next_sequence is not None
            ]
            if name in self._forgotten:
                found.append(self._forgotten[name].as_input((name, "")))
        return tuple(found)

    def _forget_one(self, name: str) -> bool:
        group = self._groups[name]
        candidates = [(id, each) for id, each in islice(group.items(), MOST_PRODUCERS) if each.waiting is None]
        if not candidates:
            return False
        before_s = self._now_s() - SILENT_S
        id, stream = min(candidates, key=lambda pair: pair[1].heard_s > before_s and pair[1].received + 1)
        del group[id]
        self._forgotten.setdefault(name, StreamState()).add(stream)
        return True


def _group(key: str) -> str:
    """The key, or the pattern of all health keys of its site."""
    parts = key.split("/", 3)
    return health_key(parts[1], "*", "*") if len(parts) == 4 and parts[2] == HEALTH_CHUNK else key
