"""The messages of a file, counted: the ledger that follows from them, and what stages and twins said last."""

from __future__ import annotations

from dataclasses import dataclass

from pipeline.recordings.sequence_ledger import SequenceLedger, StreamCounts
from schemas.codec import CodecError, decode
from schemas.envelope import Envelope
from schemas.fast_decode import decode_header
from schemas.messages import Health, ModelCard
from schemas.topics import Topic, topic_of

_HEADER_AT = 2  # of a payload, behind the key and one byte of length: what the header says, the producer first
_NEVER = b"\x00"


@dataclass(slots=True)
class _Lane:
    """A channel, and what its next message most likely begins with."""

    key: str
    topic: Topic | None
    """None: of somebody else"""
    is_news: bool
    producer: str = ""
    beginning: bytes = _NEVER
    """of a header by that producer"""
    due: int = 0


class MessageCounts:
    """Of one file. Channels and messages are told to it in the order in which they stand there."""

    def __init__(self) -> None:
        self.ledger = SequenceLedger()
        self.others: dict[str, StreamCounts] = {}
        """messages on channels that are none of ours, by topic"""
        self.healths: dict[str, Health] = {}
        """the last of each key"""
        self.cards: dict[str, ModelCard] = {}
        self.undecodable = 0
        """messages that are not what their channel says"""
        self._lanes: dict[int, _Lane] = {}

    def knows(self, channel: int) -> bool:
        """Whether the channel has been described."""
        return channel in self._lanes

    def describe(self, channel: int, key: str) -> None:
        """A channel has that key as its topic."""
        lane = self._lanes.get(channel)
        if lane is None or lane.key != key:
            try:
                topic = topic_of(key)
            except KeyError:
                topic = None
            is_news = topic is not None and topic.message in (Health, ModelCard)
            self._lanes[channel] = _Lane(key, topic, is_news)

    def count(self, channel: int, sequence: int, log_time_ns: int, data: bytes, start: int, end: int) -> None:
        """A message of a described channel, its payload data[start:end]; `sequence` is the one that MCAP has.

        Of most messages neither header nor content is decoded: same producer, next number, by MCAP's own record.
        """
        lane = self._lanes[channel]
        at = start + _HEADER_AT
        if sequence == lane.due & 0xFFFFFFFF and data.startswith(lane.beginning, at) and data[at - 1] < 0x80:
            self.ledger.note(lane.key, lane.producer, lane.due, log_time_ns)
            lane.due += 1
        elif lane.topic is None:
            account = self.others.setdefault(lane.key, StreamCounts(first_ns=log_time_ns))
            account.messages += 1
            account.last_ns = max(log_time_ns, account.last_ns or 0)
        else:
            self._decode(lane, lane.topic, log_time_ns, data[start:end])

    def _decode(self, lane: _Lane, topic: Topic, log_time_ns: int, payload: bytes) -> None:
        try:
            header = decode_header(Envelope(lane.key, topic.name, payload, log_time_ns))
            message = decode(topic.message, payload) if lane.is_news else None
        except CodecError:
            self.undecodable += 1
            return
        self.ledger.note(lane.key, header.producer, header.sequence, log_time_ns)
        if isinstance(message, Health):
            self.healths[lane.key] = message
            self.ledger.note_health(message)
        elif isinstance(message, ModelCard):
            self.cards[lane.key] = message
        else:
            name = header.producer.encode()
            beginning = bytes((0x0A, len(name))) + name if 0 < len(name) < 0x80 else _NEVER
            is_first = payload.startswith(beginning, _HEADER_AT) and payload[0] == 0x0A
            lane.producer, lane.due = header.producer, header.sequence + 1
            lane.beginning = beginning if is_first else _NEVER
