"""The bytes of a recording's messages, fast: chosen topics only, decoded or not as the reader wishes.

Typed messages one by one are `pipeline.recordings.reading`'s; here are those who read hundreds of thousands.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from google.protobuf.message import DecodeError
from mcap.opcode import Opcode
from mcap.records import Channel

from pipeline.recordings.reading import CORRUPT_DATA_ERRORS, Reading
from pipeline.recordings.records import MESSAGE, RECORD, RecordReader, message_of, open_chunk, parse
from schemas import fan_pb2
from schemas.codec import CodecError, decode, proto_type
from schemas.messages import Message
from schemas.topics import Topic, topic_of

_HEADER_FIELD = 0x0A


class Packet(NamedTuple):
    """One message as it lies in the file."""

    key: str
    topic: Topic
    log_time_ns: int
    newest_t_ns: int
    """of its newest sample; 0 for times before 1970"""
    payload: bytes


@dataclass
class PacketReading:
    """The packets of some topics, parts of a recording one after the other; one chunk at a time is in memory."""

    paths: Sequence[Path]
    topics: Collection[str]
    tray: str | None = None
    damage: dict[Path, str] = field(default_factory=dict, init=False)
    """of each part that could not be read whole: one line; known when the packets are through"""

    def __iter__(self) -> Iterator[Packet]:
        self.damage.clear()
        for path in self.paths:
            reading = Reading(path, self.topics)
            yield from self._of_part(path, reading)
            if reading.damage:
                self.damage[path] = reading.damage

    def _of_part(self, path: Path, reading: Reading) -> Iterator[Packet]:
        channels: dict[int, tuple[str, Topic]] = {}
        walk = RecordReader(path)
        for found in walk:
            try:
                if found.opcode == Opcode.CHUNK:
                    packets = self._of_chunk(open_chunk(found.content).data, channels)
                else:
                    packets = self._of_record(found.opcode, found.content, channels)
            except CORRUPT_DATA_ERRORS:
                reading.damaged_chunks += 1
            else:
                yield from packets
        reading.torn = not walk.is_complete
        reading.damaged_chunks += len(walk.damaged)

    def _of_record(self, opcode: int, content: bytes, channels: dict[int, tuple[str, Topic]]) -> list[Packet]:
        if opcode == Opcode.CHANNEL:
            channel = parse(Channel, content)
            self._note(channel.id, channel.topic, channels)
        elif opcode == Opcode.MESSAGE:
            _, channel_id, _, log_time_ns, newest_t_ns, payload = message_of(content)
            if channel_id in channels:
                return [Packet(*channels[channel_id], log_time_ns, newest_t_ns, payload)]
        return []

    def _of_chunk(self, data: bytes, channels: dict[int, tuple[str, Topic]]) -> list[Packet]:
        packets = []
        at, end = 0, len(data)
        while at < end:
            opcode, length = RECORD.unpack_from(data, at)
            at += RECORD.size
            if opcode == Opcode.MESSAGE:
                channel, _, log_time_ns, newest_t_ns = MESSAGE.unpack_from(data, at)
                if channel in channels:
                    payload = data[at + MESSAGE.size : at + length]
                    packets.append(Packet(*channels[channel], log_time_ns, newest_t_ns, payload))
            elif opcode == Opcode.CHANNEL:
                self._of_record(opcode, data[at : at + length], channels)
            at += length
        return packets

    def _note(self, number: int, key: str, channels: dict[int, tuple[str, Topic]]) -> None:
        try:
            topic = topic_of(key)
        except KeyError:
            return  # somebody else's channel
        if topic.name in self.topics and (self.tray is None or key.split("/")[2] == self.tray):
            channels[number] = (key, topic)


def header_of(packet: Packet) -> Any:
    """The header of a packet (`fan_pb2.Header`), without decoding the rest. Raises CodecError."""
    payload = packet.payload
    try:
        if len(payload) > 2 and payload[0] == _HEADER_FIELD:  # our own codec puts it first
            length, start = payload[1], 2
            if length > 0x7F:
                length, start = (length & 0x7F) | payload[2] << 7, 3
            if length < 1 << 14:
                return fan_pb2.Header.FromString(payload[start : start + length])
        message: Any = proto_type(packet.topic.message).FromString(payload)
    except DecodeError as error:
        raise CodecError(f"{packet.key}: {error}") from error
    return message.header


_Kind = TypeVar("_Kind", bound=Message)


def decode_together(kind: type[_Kind], payloads: Sequence[bytes]) -> list[_Kind]:
    """Messages of one type and one producer as few blocks as they allow, usually one.

    Protobuf appends the packed columns of messages that are parsed one after the other, so many messages cost little
    more than one. Where their columns do not fit together, each is decoded by itself. (A producer has one number of
    fans.)

    Raises:
        CodecError: one of them cannot be decoded.
    """
    if not payloads:
        return []
    try:
        return [_of_kind(kind, b"".join(payloads))]
    except CodecError:
        return [_of_kind(kind, payload) for payload in payloads]


def _of_kind(kind: type[_Kind], payload: bytes) -> _Kind:
    message = decode(kind, payload)
    assert isinstance(message, kind)
    return message
