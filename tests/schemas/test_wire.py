"""The wire protocol: encoding and decoding are inverse, and every fault is named and costs only itself."""

from __future__ import annotations

import math
import re
import struct
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from cobs import cobs
from hypothesis import given
from hypothesis import strategies as st

from fantwin.schemas.channels import CHANNELS
from fantwin.schemas.wire import (
    DEVICE_COUNTERS,
    MAX_FRAME_BYTES,
    CommandFrame,
    Decoder,
    DeviceCounters,
    Fault,
    FaultKind,
    Frame,
    Protocol,
    Sample,
    SetPointFrame,
    encode,
)

PROTOCOLS: tuple[Protocol, ...] = ("binary", "text")
UINT32 = st.integers(0, 2**32 - 1)
FLOAT32 = st.floats(width=32, allow_nan=False, allow_infinity=False)
READING = st.floats(width=32, allow_infinity=False)
SAMPLE = Sample(1000, 7, (0.5, 0.25), (101.5, -3.0))
SAMPLE_BINARY = encode("binary", SAMPLE)


@st.composite
def samples(draw: st.DrawFn, fans: int | None = None) -> Sample:
    n = fans or draw(st.sampled_from((1, 2, 3, 8)))
    column = lambda values: tuple(draw(st.lists(values, min_size=n, max_size=n)))  # noqa: E731
    return Sample(draw(UINT32), draw(UINT32), column(FLOAT32), column(READING))


def same(a: Frame | Fault, b: Frame | Fault) -> bool:
    """Equality to the last bit, with NaN equal to NaN."""
    return repr(a) == repr(b)


def faults(found: list[Frame | Fault]) -> list[FaultKind]:
    return [item.kind for item in found if isinstance(item, Fault)]


def joined(protocol: Protocol, fans: int = 2, end: str = "host") -> Decoder:
    """A decoder that has already found the beginning of a frame."""
    decoder = Decoder(protocol, fans, "device" if end == "device" else "host")
    assert decoder.feed(b"\0" if protocol == "binary" else b"\n") == []
    return decoder


def framed(payload: bytes) -> bytes:
    return b"\0" + cobs.encode(payload + struct.pack("<I", zlib.crc32(payload))) + b"\0"


@pytest.mark.parametrize("protocol", PROTOCOLS)
@given(data=st.lists(st.floats(width=32), min_size=1, max_size=8))
def test_commands_and_set_points_come_back_in_text_fan_by_fan(protocol: Protocol, data: list[float]) -> None:
    for frame in (CommandFrame(tuple(data)), SetPointFrame(tuple(data))):
        merged = [math.nan] * len(data)
        for back in Decoder(protocol, len(data), "device").feed(encode(protocol, frame)):
            assert isinstance(back, type(frame))
            values = back.command if isinstance(back, CommandFrame) else back.set_point
            merged = [old if math.isnan(new) else new for old, new in zip(merged, values, strict=True)]
        assert repr(merged) == repr(data)


@given(uptime_s=UINT32, counts=st.lists(st.integers(0, 65535), max_size=len(DEVICE_COUNTERS)).map(tuple))
def test_what_a_device_has_counted_comes_back_for_the_host_whatever_its_fans(
    uptime_s: int, counts: tuple[int, ...]
) -> None:
    frame = DeviceCounters(uptime_s, counts)
    assert joined("binary", fans=3).feed(encode("binary", frame)) == [frame]
    assert faults(joined("binary", end="device").feed(encode("binary", frame))) == [FaultKind.WRONG_TYPE]


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_after_a_reset_half_a_frame_is_forgotten(protocol: Protocol) -> None:
    decoder, frame = joined(protocol), encode(protocol, SAMPLE)
    assert decoder.feed(frame[:10]) == []
    decoder.reset()
    found = decoder.feed(frame[20:] + frame)
    assert faults(found) == [FaultKind.RESYNC]
    assert found[-1] == SAMPLE


SAMPLE_PAYLOAD = cobs.decode(SAMPLE_BINARY.strip(b"\0"))[:-4]
WITH_COLUMN = cobs.decode(encode("binary", replace(SAMPLE, measured={"current_a": (1.5, 2.5)})).strip(b"\0"))[:-4]
COUNTERS_PAYLOAD = cobs.decode(encode("binary", DeviceCounters(5, (1, 2, 3))).strip(b"\0"))[:-4]
NAN, INFINITY = struct.pack("<f", math.nan), struct.pack("<f", math.inf)
BINARY_FAULTS = {
    "garbage": (b"\0\x05helo\0", FaultKind.TRUNCATED),
    "noise of a frame's length": (b"\0" + cobs.encode(b"\x77" * 30) + b"\0", FaultKind.GARBAGE),
    "ends early": (SAMPLE_BINARY[:-3] + b"\0", FaultKind.TRUNCATED),
    "a byte missing": (b"\0" + cobs.encode(cobs.decode(SAMPLE_BINARY.strip(b"\0"))[:-1]) + b"\0", FaultKind.TRUNCATED),
    "a bit flipped": (framed(SAMPLE_PAYLOAD)[:-3] + b"\x55" + framed(SAMPLE_PAYLOAD)[-2:], FaultKind.WRONG_CRC),
    "a newer version": (framed(b"\x02" + SAMPLE_PAYLOAD[1:]), FaultKind.WRONG_VERSION),
    "an unknown type": (framed(b"\x01\x09" + SAMPLE_PAYLOAD[2:]), FaultKind.UNKNOWN_TYPE),
    "a frame for the device": (encode("binary", CommandFrame((0.5, 0.5))), FaultKind.WRONG_TYPE),
    "three fans": (encode("binary", Sample(1, 1, (0.5,) * 3, (1.0,) * 3)), FaultKind.WRONG_FAN_COUNT),
    "fan count and length differ": (framed(SAMPLE_PAYLOAD[:10] + b"\x03" + SAMPLE_PAYLOAD[11:]), FaultKind.TRUNCATED),
    "a column and length differ": (framed(WITH_COLUMN[:11] + b"\x03" + WITH_COLUMN[12:]), FaultKind.TRUNCATED),
    "an unknown column": (framed(WITH_COLUMN[:11] + b"\x08" + WITH_COLUMN[12:]), FaultKind.WRONG_TYPE),
    "ends before its columns": (framed(WITH_COLUMN[:11]), FaultKind.TRUNCATED),
    "ends before its counters": (framed(COUNTERS_PAYLOAD[:6]), FaultKind.TRUNCATED),
    "a counter missing": (framed(COUNTERS_PAYLOAD[:-2]), FaultKind.TRUNCATED),
    "too long": (b"\0" + b"\x01" * (MAX_FRAME_BYTES + 1) + b"\0", FaultKind.OVERSIZED),
    "NaN command": (framed(SAMPLE_PAYLOAD[:11] + NAN + SAMPLE_PAYLOAD[15:]), FaultKind.BAD_COMMAND),
    "infinite command": (framed(SAMPLE_PAYLOAD[:11] + INFINITY + SAMPLE_PAYLOAD[15:]), FaultKind.BAD_COMMAND),
}
TEXT_FAULTS = {
    "garbage": (b"hello\n", FaultKind.GARBAGE),
    "not ASCII": (b"\xff\xfe\x01\n", FaultKind.GARBAGE),
    "a word that begins with S": (b"Start\n", FaultKind.GARBAGE),
    "ends early": (b"S 1000 7 0.5 101.5 0.25\n", FaultKind.TRUNCATED),
    "no fans": (b"S 1000 7\n", FaultKind.TRUNCATED),
    "a frame for the device": (b"C 0 0.5\n", FaultKind.WRONG_TYPE),
    "one fan": (b"S 1000 7 0.5 101.5\n", FaultKind.WRONG_FAN_COUNT),
    "too long": (b"S" + b" 1" * MAX_FRAME_BYTES + b"\n", FaultKind.OVERSIZED),
    "a bad digit": (b"S 1000 7 0.5 1o1.5 0.25 -3\n", FaultKind.BAD_NUMBER),
    "python's own spelling of numbers": (b"S 1000 7 0.5 1_0 0.25 -3\n", FaultKind.BAD_NUMBER),
    "a clock of 33 bits": (b"S 4294967296 7 0.5 1 0.25 -3\n", FaultKind.BAD_NUMBER),
    "a negative sequence": (b"S 1000 -7 0.5 1 0.25 -3\n", FaultKind.BAD_NUMBER),
    "a group of three": (b"S 1000 7 0.5 101.5 0.25 -3 V 1 2 3\n", FaultKind.TRUNCATED),
    "an empty group": (b"S 1000 7 0.5 101.5 0.25 -3 V\n", FaultKind.TRUNCATED),
    "a group twice": (b"S 1000 7 0.5 101.5 0.25 -3 V 1 V 1\n", FaultKind.GARBAGE),
    "a group of an unknown letter": (b"S 1000 7 0.5 101.5 0.25 -3 Q 1\n", FaultKind.BAD_NUMBER),
    "a group before the pairs": (b"S 1000 7 T 25\n", FaultKind.TRUNCATED),
    "NaN command": (b"S 1000 7 nan 1 0.25 -3\n", FaultKind.BAD_COMMAND),
    "no command": (b"S 1000 7 - 1 0.25 -3\n", FaultKind.BAD_COMMAND),
    "infinite command": (b"S 1000 7 0.5 1 inf -3\n", FaultKind.BAD_COMMAND),
}


@pytest.mark.parametrize(
    ("protocol", "bad", "kind"),
    [
        pytest.param(protocol, bad, kind, id=f"{protocol}: {name}")
        for protocol, table in (("binary", BINARY_FAULTS), ("text", TEXT_FAULTS))
        for name, (bad, kind) in table.items()
    ],
)
def test_each_fault_has_its_kind_and_costs_no_other_frame(protocol: Protocol, bad: bytes, kind: FaultKind) -> None:
    good = encode(protocol, SAMPLE)
    found = joined(protocol).feed(good + bad + good)
    assert found[0] == found[-1] == SAMPLE
    assert kind in faults(found)
    assert len([item for item in found if not isinstance(item, Fault)]) == 2


def test_every_kind_of_fault_is_covered_by_an_example() -> None:
    seen = {kind for table in (BINARY_FAULTS, TEXT_FAULTS) for _, kind in table.values()}
    assert seen == set(FaultKind) - {FaultKind.RESYNC}


@given(position=st.integers(0, 8 * len(SAMPLE_PAYLOAD) - 1))
def test_the_checksum_finds_every_flipped_bit(position: int) -> None:
    body = bytearray(SAMPLE_PAYLOAD + struct.pack("<I", zlib.crc32(SAMPLE_PAYLOAD)))
    body[position // 8] ^= 1 << position % 8
    found = joined("binary").feed(b"\0" + cobs.encode(bytes(body)) + b"\0")
    assert len(found) == 1
    assert isinstance(found[0], Fault)


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        (b"S 1 2 0.5 100 1 0\r\n", Sample(1, 2, (0.5, 1.0), (100.0, 0.0))),
        (b"S\t1  2 .5 1e2 1. +0 \n", Sample(1, 2, (0.5, 1.0), (100.0, 0.0))),
        (b"S - - 0.5 100 1 0\n", Sample(None, None, (0.5, 1.0), (100.0, 0.0))),
        (b"S - 9 0.5 - 1 NAN\n", Sample(None, 9, (0.5, 1.0), (math.nan, math.nan))),
        (b"S 1 2 0.5 ovf 1 -inf\n", Sample(1, 2, (0.5, 1.0), (math.inf, -math.inf))),
        (b"S 1 2 0.5 1e60 1 0\n", Sample(1, 2, (0.5, 1.0), (math.inf, 0.0))),
    ],
)
def test_text_lines_as_printed_by_arduino_sketches_are_read(line: bytes, expected: Sample) -> None:
    (found,) = joined("text").feed(line)
    assert same(found, expected)


def test_a_person_can_type_commands() -> None:
    found = joined("text", fans=3, end="device").feed(b"C 1 0.5\r\nP 2 120\nC 3 0.5\nC 1\n")
    assert [repr(item) for item in found[:2]] == [
        repr(CommandFrame((math.nan, 0.5, math.nan))),
        repr(SetPointFrame((math.nan, math.nan, 120.0))),
    ]
    assert faults(found) == [FaultKind.WRONG_FAN_COUNT, FaultKind.TRUNCATED]


@pytest.mark.parametrize(
    ("protocol", "frame", "message"),
    [
        ("binary", Sample(None, 1, (0.5,), (1.0,)), "clock_us is missing"),
        ("binary", Sample(1, None, (0.5,), (1.0,)), "sequence is missing"),
        ("text", Sample(2**32, 1, (0.5,), (1.0,)), "does not fit 32 bits"),
        ("binary", Sample(1, -1, (0.5,), (1.0,)), "does not fit 32 bits"),
        ("text", Sample(1, 1, (0.5,), (1.0, 2.0)), "zip"),
        ("text", replace(SAMPLE, measured={"current_a": (1.0,)}), "does not have 2 values"),
        ("binary", CommandFrame(()), "0 fans"),
        ("binary", SetPointFrame((0.0,) * 65), "65 fans"),
    ],
)
def test_a_message_that_cannot_be_sent_is_refused(protocol: Protocol, frame: Frame, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        encode(protocol, frame)


@st.composite
def samples_with_columns(draw: st.DrawFn) -> Sample:
    sample = draw(samples())
    values = st.lists(READING, min_size=len(sample.command), max_size=len(sample.command)).map(tuple)
    same_for_all = READING.map(lambda value: (value,) * len(sample.command))
    chosen = draw(st.sets(st.sampled_from(CHANNELS)))
    measured = {each.name: draw(values | same_for_all) for each in CHANNELS if each in chosen}
    return replace(sample, measured=measured)


@pytest.mark.parametrize("protocol", PROTOCOLS)
@given(sample=samples_with_columns())
def test_columns_beside_command_and_speed_come_back_exactly(protocol: Protocol, sample: Sample) -> None:
    (back,) = Decoder(protocol, len(sample.command)).feed(encode(protocol, sample))
    assert same(back, sample)


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_the_longest_frame_of_64_fans_with_all_columns_fits(protocol: Protocol) -> None:
    longest = float(np.float32(-1.1754944e-38))
    each = tuple(longest * (1 + fan % 2) for fan in range(64))  # differ, or one value is sent for all
    sample = Sample(2**32 - 1, 2**32 - 1, each, each, {channel.name: each for channel in CHANNELS})
    data = encode(protocol, sample)
    assert len(data) <= MAX_FRAME_BYTES
    assert Decoder(protocol, 64).feed(data) == [sample]


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        (b"S 1 2 0.5 100 1 0 V 12\n", {"supply_voltage_v": (12.0, 12.0)}),
        (b"S 1 2 0.5 100 1 0 T 25 26 V 12 -\n", {"temperature_c": (25, 26), "supply_voltage_v": (12.0, math.nan)}),
        (
            b"S 1 2 0.5 100 1 0 I 1e-1 nan T -\n",
            {"current_a": (0.10000000149011612, math.nan), "temperature_c": 2 * (math.nan,)},
        ),
    ],
)
def test_groups_of_a_text_line_have_one_value_for_all_fans_or_one_for_each(
    line: bytes, expected: dict[str, tuple[float, ...]]
) -> None:
    (found,) = joined("text").feed(line)
    assert same(found, Sample(1, 2, (0.5, 1.0), (100.0, 0.0), {k: tuple(map(float, v)) for k, v in expected.items()}))


def test_the_worked_examples_of_the_reference_are_what_is_on_the_line():
    page = (Path(__file__).parents[2] / "docs" / "reference" / "wire-protocol.md").read_text(encoding="utf-8")
    shown = [bytes.fromhex(line) for line in re.findall(r"on the line +([0-9a-f ]+)\n", page)]
    sample = Sample(1_000_000, 42, (0.5,), (100.0,))
    frames: list[Frame] = [
        sample,
        replace(sample, measured={"supply_voltage_v": (12.0,), "temperature_c": (25.0,)}),
        DeviceCounters(60, (7, 0, 2, 0, 0, 0, 0, 0, 1, 0, 0, 0)),
        CommandFrame((0.75, math.nan)),
    ]
    assert shown == [encode("binary", frame) for frame in frames]
