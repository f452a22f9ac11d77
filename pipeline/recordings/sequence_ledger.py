"""The sequence ledger of a recording: how many messages of each stream were recorded, are missing, or came twice.

See schemas/streams.py for what a stream is and how its gaps are counted.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace

from pydantic import TypeAdapter

from fantwin.schemas.codec import CodecError, decode, decode_header
from fantwin.schemas.health import Health
from fantwin.schemas.messages import ModelCard
from fantwin.schemas.streams import StreamId, StreamState, output_streams
from fantwin.schemas.topics import HEALTH, known_topic

LEDGER_NAME = "fantwin.ledger"
"""the metadata record, after the last message, that holds a finished ledger"""
ENDED = "ended"
"""its entry for a part with which the recorder was stopped in order"""
RECOVERED = "recovered"
"""its entry in a repaired file: what was lost, or may have been"""
BEFORE_NAME = "fantwin.before"
"""the metadata record, before the first message, that holds the next expected sequence number of each stream"""


@dataclass(slots=True)
class StreamCounts:
    """The messages of one stream in a recording.

    `missing` includes the gap before the first message where the parts before show one. Sequence numbers and times of
    receipt are those of the messages in the file; None without any. In a damaged file `last_sequence` is that of the
    last message that was recorded.
    """

    messages: int = 0
    missing: int = 0
    duplicated: int = 0
    first_sequence: int | None = None
    last_sequence: int | None = None
    first_ns: int | None = None
    last_ns: int | None = None


_COUNTS, _LINES = TypeAdapter(StreamCounts), TypeAdapter(list[str])


class SequenceLedger:
    """Counts messages in the order in which they are recorded."""

    def __init__(self, before: Mapping[StreamId, int] | None = None, left_out: Collection[str] = ()) -> None:
        """before: the next expected sequence number of each stream, after the parts before this one. left_out: topics
        that are not recorded on purpose, so that nothing of them is missing."""
        self.counts: dict[StreamId, StreamCounts] = {}
        self.left_out = left_out
        self._streams = {
            stream: StreamState(sequence) for stream, sequence in (before or {}).items() if self._is_recorded(stream[0])
        }
        self._thinned = set(filter(_is_thinned, self._streams))
        """streams that are recorded only in part, so that a gap in them is no loss"""
        self._published: dict[StreamId, int] = {}

    @property
    def next(self) -> dict[StreamId, int]:
        """The next expected sequence number of each stream."""
        streams = self._streams.items()
        return {stream: state.next_sequence for stream, state in streams if state.next_sequence is not None}

    def add(self, key: str, producer: str, sequence: int, received_t_ns: int) -> None:
        """Count a recorded message. The card of a twin is repeated at the start of each part and counts once."""
        stream = (key, producer)
        state = self._streams.get(stream) or self._state(stream)
        if stream in self._thinned and state.next_sequence is not None:
            state.next_sequence = max(sequence, state.next_sequence)
        if key.endswith("/twin") and state.is_duplicate(sequence):
            return
        counts = self.counts.get(stream)
        if counts is None:
            counts = self.counts[stream] = StreamCounts()
        if counts.messages == 0:
            counts.first_sequence = sequence
        counts.messages += 1
        if counts.first_ns is None or received_t_ns < counts.first_ns:  # the host's clock may be set back
            counts.first_ns = received_t_ns
        if counts.last_ns is None or received_t_ns > counts.last_ns:
            counts.last_ns = received_t_ns
        if state.accept(sequence):
            counts.last_sequence = sequence
        counts.missing, counts.duplicated = state.missing, state.duplicated

    def add_health(self, health: Health) -> None:
        """Use a recorded health: it says how many messages its stage had published."""
        for stream, published in output_streams(health).items():
            if self._is_recorded(stream[0]):
                self._published[stream] = published
                if published == 0:
                    self._state(stream).skip_to(0)  # all its messages are known from here on: recorded or missing

    def add_lost(self, key: str, producer: str, sequence: int) -> None:
        """A received message will not be recorded: it is missing as soon as a later one is recorded, or at the end."""
        stream = (key, producer)
        state = self._state(stream)
        if stream in self._thinned:
            return
        if state.next_sequence is None:
            state.skip_to(sequence)
        self._published[stream] = max(sequence + 1, self._published.get(stream, 0))

    def add_duplicated(self, key: str, producer: str, count: int = 1) -> None:
        """Count messages that came again and were not recorded again."""
        state = self._state((key, producer))
        state.duplicated += count
        self.counts.setdefault((key, producer), StreamCounts()).duplicated = state.duplicated

    def unrecorded(self) -> dict[StreamId, int]:
        """How many messages of each stream are known (from health, say) to follow the last one recorded."""
        due = self.next
        behind = {stream: published - due.get(stream, published) for stream, published in self._published.items()}
        return {stream: count for stream, count in behind.items() if count > 0}

    def finish(self) -> None:
        """End the session: what was published and has not come is missing."""
        for stream in self.unrecorded():
            state = self._state(stream)
            state.skip_to(self._published[stream])
            self.counts.setdefault(stream, StreamCounts()).missing = state.missing

    def for_next_part(self) -> SequenceLedger:
        """An empty ledger that continues this one."""
        ledger = SequenceLedger(self.next, self.left_out)
        ledger._published = self._published
        return ledger

    def as_lost(self) -> SequenceLedger:
        """An empty ledger in place of this one, whose file is lost: what it counted is missing from now on."""
        known = self.next
        ledger = SequenceLedger({stream: self._streams[stream].first_sequence for stream in known}, self.left_out)
        ledger._published = self._published
        for stream, sequence in known.items():
            if stream not in self._thinned:
                ledger._published[stream] = max(sequence, self._published.get(stream, 0))
        return ledger

    def before_as_metadata(self) -> dict[str, str]:
        """`next` as a metadata record; meant for the start of a part."""
        return {" ".join(stream): str(sequence) for stream, sequence in self.next.items()}

    def _is_recorded(self, key: str) -> bool:
        topic = known_topic(key)
        return topic is not None and topic.recorded and topic.name not in self.left_out

    def _state(self, stream: StreamId) -> StreamState:
        state = self._streams.get(stream)
        if state is None:
            state = self._streams[stream] = StreamState()
            if _is_thinned(stream):
                self._thinned.add(stream)
        return state


def ledger_metadata(
    streams: Mapping[StreamId, StreamCounts], *, has_ended: bool = False, recovered: Sequence[str] = ()
) -> dict[str, str]:
    """The ledger as a metadata record: `<key> <producer>` to the counts as JSON.

    recovered: in a repaired file, what was lost or may have been, one line each.
    """
    entries = {" ".join(stream): json.dumps(asdict(counts)) for stream, counts in streams.items()}
    if has_ended:
        entries[ENDED] = "in order"
    if recovered:
        entries[RECOVERED] = json.dumps(list(recovered))
    return entries


def counts_from_metadata(metadata: Mapping[str, str]) -> dict[StreamId, StreamCounts]:
    """The counts in a ledger's metadata record. Raises ValueError if it is not one."""
    streams = {}
    for name, text in metadata.items():
        if name not in (ENDED, RECOVERED):
            streams[_stream(name)] = _COUNTS.validate_json(text, strict=True)
    return streams


def recovered_from_metadata(metadata: Mapping[str, str]) -> tuple[str, ...]:
    """What the ledger of a repaired file reports as lost, one line each. Raises ValueError if it is not that."""
    return tuple(_LINES.validate_json(metadata.get(RECOVERED, "[]"), strict=True))


def before_from_metadata(metadata: Mapping[str, str]) -> dict[StreamId, int]:
    """What `before_as_metadata` has written. Raises ValueError if it is not that."""
    return {_stream(name): int(text) for name, text in metadata.items()}


def correct_for_damage(
    recorded: Mapping[StreamId, StreamCounts], found: Mapping[StreamId, StreamCounts]
) -> dict[StreamId, StreamCounts]:
    """The ledger of a file that was damaged later: what it says was recorded and is not found is missing."""
    streams = dict(found)
    for stream, counts in recorded.items():
        here = found.get(stream, StreamCounts())
        streams[stream] = replace(
            counts,
            messages=here.messages,
            missing=counts.missing + max(0, counts.messages - here.messages),
            first_sequence=here.first_sequence,
            first_ns=here.first_ns,
            last_ns=here.last_ns,
        )
    return streams


def next_sequences(before: Mapping[StreamId, int], streams: Mapping[StreamId, StreamCounts]) -> dict[StreamId, int]:
    """The next expected sequence number of each stream after a part."""
    last = {stream: counts.last_sequence for stream, counts in streams.items()}
    return dict(before) | {stream: sequence + 1 for stream, sequence in last.items() if sequence is not None}


def sum_by_key(streams: Iterable[tuple[StreamId, StreamCounts]]) -> dict[str, StreamCounts]:
    """The sum over the producers of each key, without sequence numbers: each producer has its own."""
    found: dict[str, StreamCounts] = {}
    for (key, _), counts in streams:
        total = found.setdefault(key, StreamCounts())
        total.messages += counts.messages
        total.missing += counts.missing
        total.duplicated += counts.duplicated
        if counts.first_ns is not None and counts.last_ns is not None:
            total.first_ns = min(counts.first_ns, total.first_ns if total.first_ns is not None else counts.first_ns)
            total.last_ns = max(counts.last_ns, total.last_ns or 0)
    return dict(sorted(found.items()))


def _is_thinned(stream: StreamId) -> bool:
    """Whether a stream has health messages: a recorder takes only those that report something new."""
    topic = known_topic(stream[0])
    return topic is not None and topic.name == HEALTH


def _stream(name: str) -> StreamId:
    key, _, producer = name.partition(" ")
    return key, producer


class MessageCounts:
    """Counts of one file: its sequence ledger, and the last health of each session and card of each twin.

    Messages are added in file order.
    """

    def __init__(self) -> None:
        self.ledger = SequenceLedger()
        self.others: dict[str, StreamCounts] = {}
        """messages on channels that are not fantwin's, by topic"""
        self.sessions: dict[str, Health] = {}
        """the last health of each session, by its producer; the session heard last is at the end"""
        self.cards: dict[str, ModelCard] = {}
        self.undecodable = 0
        """messages that do not have the type of their channel"""

    def add(self, key: str, received_t_ns: int, payload: bytes) -> None:
        """Add a message."""
        topic = known_topic(key)
        if topic is None:
            counts = self.others.setdefault(key, StreamCounts(first_ns=received_t_ns))
            counts.messages += 1
            counts.last_ns = max(received_t_ns, counts.last_ns or 0)
            return
        try:
            header = decode_header(topic.message, payload)
            message = decode(topic.message, payload) if topic.message in (Health, ModelCard) else None
        except CodecError:
            self.undecodable += 1
            return
        self.ledger.add(key, header.producer, header.sequence, received_t_ns)
        if isinstance(message, Health):
            self.sessions.pop(header.producer, None)
            self.sessions[header.producer] = message
            self.ledger.add_health(message)
        elif isinstance(message, ModelCard):
            self.cards[key] = message
