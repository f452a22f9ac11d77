"""Counts the messages of a file: its sequence ledger, and the last health of each session and card of each twin."""

from __future__ import annotations

from dataclasses import dataclass

from fantwin.pipeline.recordings.sequence_ledger import SequenceLedger, StreamCounts
from fantwin.schemas.codec import CodecError
from fantwin.schemas.envelope import Envelope
from fantwin.schemas.fast_decode import decode_header
from fantwin.schemas.health import Health
from fantwin.schemas.messages import ModelCard
from fantwin.schemas.topics import Topic, topic_of

_PRODUCER_AT = 2  # in a payload, after the header's key and one byte of length: the producer is its first field
_NOTHING = b"\x00"  # no payload continues so


@dataclass(slots=True)
class ChannelState:
    """A channel, and what its next message is expected to look like."""

    key: str
    topic: Topic | None
    """None: not a topic of fantwin"""
    is_status: bool
    """the last message matters: health or a twin's card"""
    producer: str = ""
    encoded_producer: bytes = _NOTHING
    next_sequence: int = 0


class MessageCounts:
    """Of one file. Channels and messages are added in file order."""

    def __init__(self) -> None:
        self.ledger = SequenceLedger()
        self.others: dict[str, StreamCounts] = {}
        """messages on channels that are not fantwin's, by topic"""
        self.sessions: dict[str, Health] = {}
        """the last health of each session, by its producer; the session heard last is at the end"""
        self.cards: dict[str, ModelCard] = {}
        self.undecodable = 0
        """messages that do not have the type of their channel"""
        self._channels: dict[int, ChannelState] = {}

    def knows(self, channel: int) -> bool:
        """Whether the channel has been added."""
        return channel in self._channels

    def add_channel(self, channel: int, key: str) -> None:
        """Add a channel whose topic is `key`."""
        state = self._channels.get(channel)
        if state is None or state.key != key:
            try:
                topic = topic_of(key)
            except KeyError:
                topic = None
            is_status = topic is not None and topic.message in (Health, ModelCard)
            self._channels[channel] = ChannelState(key, topic, is_status)

    def add(self, channel: int, sequence: int, received_t_ns: int, data: bytes, start: int, end: int) -> None:
        """Add a message of a known channel; its payload is data[start:end], `sequence` the one in MCAP's record.

        Most messages have the same producer as the one before and the next sequence number: comparing bytes shows
        that, and nothing is decoded. That makes repairing a file twice as fast.
        """
        state = self._channels[channel]
        at = start + _PRODUCER_AT
        if (
            sequence == state.next_sequence & 0xFFFFFFFF
            and data.startswith(state.encoded_producer, at)
            and data[at - 1] < 0x80
        ):
            self.ledger.add(state.key, state.producer, state.next_sequence, received_t_ns)
            state.next_sequence += 1
        elif state.topic is None:
            counts = self.others.setdefault(state.key, StreamCounts(first_ns=received_t_ns))
            counts.messages += 1
            counts.last_ns = max(received_t_ns, counts.last_ns or 0)
        else:
            self._decode(state, Envelope(state.key, state.topic.name, data[start:end], received_t_ns))

    def _decode(self, state: ChannelState, envelope: Envelope) -> None:
        try:
            header = decode_header(envelope)
            message = envelope.message if state.is_status else None
        except CodecError:
            self.undecodable += 1
            return
        self.ledger.add(state.key, header.producer, header.sequence, envelope.received_t_ns)
        if isinstance(message, Health):
            self.sessions.pop(header.producer, None)
            self.sessions[header.producer] = message
            self.ledger.add_health(message)
        elif isinstance(message, ModelCard):
            self.cards[state.key] = message
        else:
            name = header.producer.encode()
            encoded = bytes((0x0A, len(name))) + name if 0 < len(name) < 0x80 else _NOTHING
            is_first = envelope.payload.startswith(encoded, _PRODUCER_AT) and envelope.payload[0] == 0x0A
            state.producer, state.next_sequence = header.producer, header.sequence + 1
            state.encoded_producer = encoded if is_first else _NOTHING
