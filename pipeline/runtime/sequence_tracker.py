"""Puts arriving messages in sequence: requests missing messages, drops duplicates, and counts what remains missing.

Nothing here waits. While the missing messages of a stream are on their way, its later messages are held; all other
streams go on. What is held, and the number of streams that are remembered, are bounded, however many producers publish,
and however much: docs/reference/bounds.md.
"""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import islice
from typing import TypeAlias

from fantwin.pipeline.runtime.sessions import Sessions
from fantwin.schemas.envelope import Envelope
from fantwin.schemas.health import Health, Input
from fantwin.schemas.streams import StreamId, StreamState, output_streams
from fantwin.schemas.topics import CATCH_UP_MESSAGES, HEALTH_CHUNK, health_key

MOST_PRODUCERS = 64
"""of one key are remembered. Every `fantwin alarms acknowledge` is a producer of its own."""
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


MOST_HELD_MESSAGES = 4096
"""of one stream"""
MOST_HELD_BYTES = 64 << 20
"""of one stream. Beyond either limit it goes on without the messages that were requested."""
PATIENCE_S, PATIENCE_WITH_REPLACED_S = 120.0, 5.0
"""how long requests to a stage without an answer are repeated: its link may be slow, lose packets, or work in one
direction only. The second is for a stage whose place another process has taken: only its last answer may still
arrive"""
ASKED_AGAIN_AFTER_S = 0.5
REFUSAL_SHOWN_S = 60.0
"""how long health names what was refused"""


@dataclass(frozen=True, slots=True)
class Found:
    """The answer to a request.

    Attributes:
        envelopes: the messages still kept.
        published: how many messages their producer says it has published; None: it did not answer.
        was_asked: whether the producer was asked at all.
    """

    envelopes: Sequence[Envelope] = ()
    published: int | None = None
    was_asked: bool = True


Ask: TypeAlias = Callable[[Request], Found | None]


class SequenceTracker:
    """Tracks every stream a stage reads.

    `ask` requests messages that a producer still keeps. It returns the answer, or None if the answer comes later: then
    it is passed to `answer`.

    The first message seen of a stream need not be its first. Earlier messages that the producer still keeps are asked
    for; those it no longer keeps are history, not a loss. A stage that does not answer, or not completely, is asked
    again for a while; then what it may have kept counts as missing. From then on every gap is either recovered or
    counted.
    """

    def __init__(
        self,
        ask: Ask,
        now_s: Callable[[], float] = time.monotonic,
        sessions: Sessions | None = None,
        sampled: Collection[str] = (),
    ) -> None:
        """sessions: the stages that are alive. sampled: keys of which some messages are left out, so that a gap is no
        loss."""
        self._ask = ask
        self._sampled = frozenset(sampled)
        self._now_s = now_s
        self._sessions = sessions or Sessions()
        self._streams = TrackedStreams(now_s, self._sessions)
        self._refused: Counter[str] = Counter()
        self._refusal = ""
        self._refused_s = 0.0

    def accept(self, envelope: Envelope) -> list[Envelope]:
        """The messages to process now that this one has arrived: none if it is held, a duplicate, or refused."""
        producer = envelope.header.producer
        stream = self._streams.heard(envelope.key, producer)
        if stream is None:
            is_stranger = self._sessions.is_stranger(envelope.key, producer)
            why = f"{producer} is not a stage of this site" if is_stranger else "too many producers at once"
            self._refuse("refused_producers", f"{envelope.key}: {why}")
            return []
        waiting = stream.waiting
        if waiting is None:
            if envelope.key in self._sampled:
                stream.next_sequence = max(envelope.header.sequence, stream.next_sequence or 0)
            return self._take(stream, envelope)
        waiting.hold(envelope)
        if len(waiting.held) > MOST_HELD_MESSAGES or waiting.held_bytes > MOST_HELD_BYTES:
            return self._go_on(stream, waiting, Found())
        return []

    def accept_kept(self, envelopes: Iterable[Envelope]) -> list[Envelope]:
        """The messages to process of those that producers keep from before this consumer started, in sequence."""
        streams: dict[StreamId, list[Envelope]] = {}
        for envelope in sorted(envelopes, key=lambda each: each.header.sequence):
            streams.setdefault((envelope.key, envelope.header.producer), []).append(envelope)
        return [due for id, kept in streams.items() for due in self._take_kept(id, kept)]

    def reconcile(self, health: Health, keys: Iterable[str]) -> list[Envelope]:
        """Request messages on `keys` that a producer reports as published and that never arrived. On a topic with few
        messages no next message would show the gap."""
        wanted, due = set(keys) - self._sampled, []
        for (key, producer), published in output_streams(health).items():
            stream = self._streams.heard(key, producer) if key in wanted else None
            if stream is None or stream.waiting:
                continue
            if published and (stream.next_sequence is None or published > stream.next_sequence):
                due += self._request(stream, published, None)
            else:
                stream.skip_to(published)
                stream.heard_s = self._now_s()
        return due

    def has_all_of(self, id: StreamId, published: int) -> bool:
        """Whether all messages of a stream up to this number have arrived, or are known to be lost."""
        stream = self._streams.get(*id)
        return published == 0 or (
            stream is not None and stream.waiting is None and (stream.next_sequence or 0) >= published
        )

    def answer(self, request: Request, found: Found) -> list[Envelope]:
        """The messages to process now that a request has been answered."""
        stream = self._streams.get(request.key, request.producer)
        if stream is None or stream.waiting is None or stream.waiting.request is not request:
            return []  # the stream went on without the answer
        return self._go_on(stream, stream.waiting, found, may_ask_again=True)

    def give_up(self) -> list[Envelope]:
        """Go on without the answers that are due: the messages to process now."""
        due: list[Envelope] = []
        for stream in self._streams:
            while stream.waiting is not None:
                due += self._go_on(stream, stream.waiting, Found())
        return due

    @property
    def is_waiting(self) -> bool:
        """Whether an answer is due."""
        return any(stream.waiting for stream in self._streams)

    @property
    def held(self) -> int:
        """How many messages are held until an answer comes."""
        waiting = [stream.waiting for stream in self._streams if stream.waiting]
        return sum(len(each.held) + (each.shown_by is not None) for each in waiting)

    def inputs(self, unsaved: Iterable[Envelope] = ()) -> tuple[Input, ...]:
        """The counts for health. Forgotten producers of a key are summed up under an empty name. unsaved: the messages
        that are lost if the stage is killed now."""
        return self._streams.inputs(unsaved)

    def counters(self) -> Mapping[str, int]:
        """What was refused; docs/reference/messages.md explains it."""
        return self._refused

    def problem(self) -> str:
        """What was refused last, while it is recent; empty if nothing."""
        return self._refusal if self._refusal and self._now_s() - self._refused_s < REFUSAL_SHOWN_S else ""

    def _take(self, stream: Stream, envelope: Envelope) -> list[Envelope]:
        sequence, expected = envelope.header.sequence, stream.next_sequence
        if sequence != expected and not stream.is_duplicate(sequence) and (expected is not None or sequence > 0):
            return self._request(stream, sequence, envelope)
        stream.heard_s = self._now_s()
        return [envelope] if stream.accept(sequence) else []

    def _take_kept(self, id: StreamId, kept: Sequence[Envelope]) -> list[Envelope]:
        stream, first = self._streams.heard(*id), kept[0].header.sequence
        if stream and stream.next_sequence is None:
            if stream.waiting:  # its first message came live before these: they answer what it made this consumer ask
                return self._go_on(stream, stream.waiting, Found(kept))
            stream.skip_to(first)
        return [due for envelope in kept for due in self.accept(envelope)]

    def _request(self, stream: Stream, until: int, shown_by: Envelope | None) -> list[Envelope]:
        """Request what is missing before `until`."""
        first = stream.next_sequence if stream.next_sequence is not None else max(0, until - CATCH_UP_MESSAGES)
        request = Request(stream.key, stream.producer, first, until - 1)
        stream.waiting = waiting = Waiting(request, until, shown_by, self._now_s())
        found = self._ask(request)
        return [] if found is None else self._go_on(stream, waiting, found, may_ask_again=True)

    def _ask_again(self, stream: Stream, waiting: Waiting, *, is_at_once: bool) -> list[Envelope]:
        """Request the rest of what was requested."""
        before, now_s = waiting.request, self._now_s()
        first = max(before.first, stream.next_sequence or 0)
        again_s = 0.0 if is_at_once else now_s + ASKED_AGAIN_AFTER_S
        waiting.request = Request(stream.key, stream.producer, first, before.last, again_s)
        if is_at_once:
            waiting.since_s = now_s
        stream.waiting = waiting
        found = self._ask(waiting.request)
        return [] if found is None else self._go_on(stream, waiting, found)

    def _patience_s(self, stream: Stream) -> float:
        if self._sessions.is_alive(stream.producer) or self._sessions.may_return(stream.producer):
            return PATIENCE_S
        return PATIENCE_WITH_REPLACED_S if self._sessions.has_ended(stream.producer) else 0.0

    def _go_on(self, stream: Stream, waiting: Waiting, found: Found, *, may_ask_again: bool = False) -> list[Envelope]:
        """Process what was found, then what was held; or ask for the rest, if the answer was not complete."""
        stream.waiting = None
        due: list[Envelope] = []
        for envelope in sorted(found.envelopes, key=lambda each: each.header.sequence):
            header = envelope.header
            if (envelope.key, header.producer) != (stream.key, stream.producer) or header.sequence >= waiting.until:
                continue
            if header.sequence >= waiting.request.first and not stream.is_duplicate(header.sequence):
                stream.accept(header.sequence)
                due.append(envelope)
        is_incomplete = found.was_asked and found.published is None and stream.next_sequence != waiting.until
        is_patient = bool(due) or self._now_s() - waiting.since_s < self._patience_s(stream)
        if may_ask_again and is_incomplete and is_patient:
            return due + self._ask_again(stream, waiting, is_at_once=bool(due))
        if stream.next_sequence is None and self._owes_answer(stream, found):
            stream.next_sequence = waiting.request.first
        stream.skip_to(waiting.until)
        stream.heard_s = self._now_s()
        arrived = [waiting.shown_by] if waiting.shown_by else []
        for envelope in (*arrived, *waiting.held):
            if stream.waiting is None:
                due += self._take(stream, envelope)
            else:
                stream.waiting.hold(envelope)
        return due

    def _owes_answer(self, stream: Stream, found: Found) -> bool:
        return found.was_asked and found.published is None and self._sessions.is_alive(stream.producer)

    def _refuse(self, counter: str, line: str) -> None:
        self._refused[counter] += 1
        self._refusal, self._refused_s = f"{line}; another program publishes here: stop it", self._now_s()
