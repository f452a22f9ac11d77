"""Counts the messages of a file: its sequence ledger, and the last health of each session and card of each twin."""

from __future__ import annotations

from fantwin.pipeline.recordings.sequence_ledger import SequenceLedger, StreamCounts
from fantwin.schemas.codec import CodecError, decode, decode_header
from fantwin.schemas.health import Health
from fantwin.schemas.messages import ModelCard
from fantwin.schemas.topics import known_topic


class MessageCounts:
    """Counts of one file. Messages are added in file order."""

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
