"""Packets: the bytes of a recording, the same as its messages read one by one, and past what is damaged."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from mcap.opcode import Opcode

from pipeline.recordings.packets import PacketReading, decode_together, header_of
from pipeline.recordings.reading import read_recording
from pipeline.recordings.records import RecordReader
from schemas.codec import CodecError, decode, encode
from schemas.messages import Header, InputPosition, Raw, newest_t_ns
from schemas.topics import BY_NAME
from tests.support.message_strategies import same

GOLDEN = Path(__file__).parents[2] / "support" / "data" / "golden.mcap"


def raw(sequence: int, fans: int = 2, position: InputPosition | None = None) -> Raw:
    return Raw(
        header=Header("acquisition-1", sequence, "tray1", position),
        fans=fans,
        host_receive_t_ns=np.array([sequence + 5], np.int64),
        command=np.full((1, fans), sequence / 7),
        speed_rad_s=np.full((1, fans), np.nan),
    )


def test_they_are_the_messages_of_the_recording():
    topics = ("raw", "score", "alarm")
    entries, packets = list(read_recording(GOLDEN, topics)), list(PacketReading([GOLDEN], topics))
    assert [(p.key, p.topic.name, p.log_time_ns) for p in packets] == [(e.key, e.topic, e.log_time_ns) for e in entries]
    for packet, entry in zip(packets, entries, strict=True):
        assert packet.payload == encode(entry.message)
        assert packet.newest_t_ns == newest_t_ns(entry.message)


def test_of_another_tray_there_are_none():
    assert not list(PacketReading([GOLDEN], ("raw",), tray="tray2"))


def test_a_header_is_read_without_the_rest():
    for packet in PacketReading([GOLDEN], ("grid", "prediction", "score")):
        header = header_of(packet)
        whole = decode(packet.topic.message, packet.payload).header
        assert (header.producer, header.sequence, header.tray) == (whole.producer, whole.sequence, whole.tray)
        assert whole.input_position and header.input_position.sequence == whole.input_position.sequence


def test_a_header_of_any_length_is_read():
    for length in (1, 100, 130, 20_000):
        message = raw(3, position=InputPosition("raw", "p" * length, 9, 10, 0))
        packet = next(iter(PacketReading([GOLDEN], ("raw",))))._replace(payload=encode(message))
        assert header_of(packet).input_position.producer == "p" * length


def test_bytes_that_are_no_message_are_told():
    packet = next(iter(PacketReading([GOLDEN], ("raw",))))
    for payload in (b"\x0a\x05\xff", b"\xff\xff\xff", b"\x0a\x02\xff\xff"):
        with pytest.raises(CodecError):
            header_of(packet._replace(payload=payload))


def test_many_are_decoded_as_one_block():
    messages = [raw(k) for k in range(100)]
    (block,) = decode_together(Raw, [encode(message) for message in messages])
    assert block.header.sequence == 99
    for name in ("host_receive_t_ns", "command", "speed_rad_s"):
        assert same(getattr(block, name), np.concatenate([getattr(message, name) for message in messages]))


def test_those_that_do_not_fit_together_are_decoded_one_by_one():
    blocks = decode_together(Raw, [encode(raw(0, fans=2)), encode(raw(1, fans=3))])
    assert [block.fans for block in blocks] == [2, 3]
    assert decode_together(Raw, []) == []


def test_a_torn_file_is_read_as_far_as_it_goes_and_says_so(tmp_path):
    torn = tmp_path / "torn.mcap"
    torn.write_bytes(GOLDEN.read_bytes()[: GOLDEN.stat().st_size // 2])
    reading = PacketReading([torn], ("score",))
    found = list(reading)
    assert 0 < len(found) < len(list(PacketReading([GOLDEN], ("score",))))
    assert "breaks off" in reading.damage[torn]


def test_a_damaged_chunk_costs_that_chunk_only(tmp_path):
    damaged = tmp_path / "damaged.mcap"
    content = bytearray(GOLDEN.read_bytes())
    chunks = [found for found in RecordReader(GOLDEN) if found.opcode == Opcode.CHUNK]
    content[chunks[len(chunks) // 2].end - 10] ^= 0xFF
    damaged.write_bytes(content)
    reading = PacketReading([damaged], tuple(BY_NAME))
    found, whole = list(reading), list(PacketReading([GOLDEN], tuple(BY_NAME)))
    assert 0.5 * len(whole) < len(found) < len(whole)
    assert "damaged chunks left out: 1" in reading.damage[damaged]


def test_parts_are_read_one_after_the_other():
    reading = PacketReading([GOLDEN, GOLDEN], ("score",))
    once = len(list(PacketReading([GOLDEN], ("score",))))
    assert len(list(reading)) == 2 * once
    assert reading.damage == {}
