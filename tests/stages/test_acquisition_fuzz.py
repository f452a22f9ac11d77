"""Any bytes on the line: acquisition never raises, holds little, loses no valid frame and counts everything."""

from __future__ import annotations

import random
from collections import Counter
from itertools import cycle
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fantwin.pipeline.config.settings import TrayConfig
from fantwin.pipeline.sources.serial.config import SerialConfig
from fantwin.pipeline.sources.serial.port import ReceivedBytes
from fantwin.pipeline.sources.source import LinkUp
from fantwin.schemas.messages import Raw
from fantwin.schemas.wire import (
    MAX_FRAME_BYTES,
    CommandFrame,
    Decoder,
    Fault,
    FaultKind,
    Protocol,
    Sample,
    SetPointFrame,
    encode,
)
from fantwin.stages.acquisition import AcquisitionConfig
from tests.support.serial_core import FakeLink, SerialCore

FANS = 2
PROTOCOLS: tuple[Protocol, ...] = ("binary", "text")
FIRST_SEQUENCE = 2**32 - 32  # the sequence wraps within the pool


def make_core(protocol: Protocol, block_s: float = 0.0) -> SerialCore:
    tray = TrayConfig(name="bench", fans=FANS, source=SerialConfig(port="/dev/ttyTEST", protocol=protocol))
    core = SerialCore(tray, AcquisitionConfig(block_s=block_s), FakeLink())
    core.step(LinkUp())
    return core


def sample(number: int) -> Sample:
    chance = random.Random(number)
    command = tuple(chance.randrange(1024) / 1024 for _ in range(FANS))
    speed = tuple(chance.randrange(1 << 20) / 1024 for _ in range(FANS))
    return Sample((2**32 - 100_000 + 10_000 * number) % 2**32, (FIRST_SEQUENCE + number) % 2**32, command, speed)


NOT_WANTED = (
    CommandFrame((0.5,) * FANS),
    SetPointFrame((10.0,) * FANS),
    Sample(1, 1, (0.5,) * (FANS + 1), (1.0,) * (FANS + 1)),
    Sample(1, 1, (0.5, float("nan")), (1.0, 1.0)),
    Sample(1, 1, (0.5, 99.0), (1.0, 1.0)),
)
CHANGED = st.tuples(st.integers(0, 60), st.binary(max_size=8), st.integers(0, 8))
"""place in a frame, and what is there instead of so many of its bytes"""
NOISE = st.binary(min_size=1, max_size=40) | st.integers(MAX_FRAME_BYTES - 1, MAX_FRAME_BYTES + 99).map(b"x".__mul__)
PIECES = st.sampled_from(("whole", "whole", "twice", "left out", *NOT_WANTED, b"# a comment\n")) | CHANGED | NOISE


def stream_of(protocol: Protocol, pieces: list[Any]) -> tuple[bytes, list[Sample]]:
    """A stream, and the samples in it that were not changed, in order."""
    stream, untouched = b"", []
    for number, piece in enumerate(pieces):
        frame = encode(protocol, sample(number))
        if piece in ("whole", "twice"):
            is_comment = protocol == "text" and stream.rpartition(b"\n")[2].startswith(b"#")
            stream += frame  # after half a comment, a line of text is part of the comment
            if not is_comment:
                untouched.append(sample(number))
                stream += frame if piece == "twice" else b""
        elif isinstance(piece, tuple):
            at, instead, gone = piece
            stream += frame[:at] + instead + frame[at + gone :]
        elif piece != "left out":
            stream += piece if isinstance(piece, bytes) else encode(protocol, piece)
    return stream, untouched


def samples_of(messages: list[Raw]) -> list[Sample]:
    return [
        Sample(int(clock_us), int(sequence), tuple(command.tolist()), tuple(speed.tolist()))
        for raw in messages
        if len(raw.device_clock_us) and len(raw.device_sequence)
        for clock_us, sequence, command, speed in zip(
            raw.device_clock_us, raw.device_sequence, raw.command, raw.speed_rad_s, strict=True
        )
    ]


def is_within(wanted: list[Sample], found: list[Sample]) -> bool:
    """Whether `wanted` is a subsequence of `found`."""
    rest = iter(found)
    return all(sample in rest for sample in wanted)


def outcomes_by_kind(protocol: Protocol, stream: bytes) -> Counter[str]:
    """Samples and faults by kind that the decoder finds in a stream fed in one piece."""
    found = Decoder(protocol, FANS).feed(stream)
    return Counter(item.kind.value if isinstance(item, Fault) else "samples" for item in found)


@pytest.mark.parametrize("protocol", PROTOCOLS)
@settings(max_examples=60)
@given(
    pieces=st.lists(PIECES, min_size=1, max_size=8),
    sizes=st.lists(st.sampled_from((1, 7, 40, 9999)), min_size=1, max_size=4),
    block_s=st.sampled_from((0.0, 0.05)),
)
def test_changed_streams_are_counted_to_the_last_frame(
    protocol: Protocol, pieces: list[Any], sizes: list[int], block_s: float
) -> None:
    stream, untouched = stream_of(protocol, pieces)
    core, rest, wanted = make_core(protocol, block_s), stream, cycle(sizes)
    messages: list[Raw] = []
    while rest:
        size = next(wanted)
        messages += core.step(ReceivedBytes(rest[:size], 0))
        rest = rest[size:]
        assert len(core.source._decoder._pending) <= MAX_FRAME_BYTES + 1
    messages += core.close()

    counts = Counter(core.counters())
    published = sum(len(raw.host_receive_t_ns) for raw in messages)
    assert is_within(untouched, samples_of(messages)), "an untouched frame is missing"
    assert counts["bytes"] == len(stream)
    assert counts["samples"] == published, "a sample was counted and not published, or the reverse"

    outcomes = outcomes_by_kind(protocol, stream)
    assert outcomes.pop("samples", 0) == counts["samples"] + counts["repeated"] + counts["absurd_command"]
    assert outcomes == +Counter({kind.value: counts[kind.value] for kind in FaultKind}), "a fault has no count"
    if protocol == "binary":  # with a checksum all output is correct, so that the sequence must add up
        frames = stream.split(b"\0")[:-1]
        good = counts["samples"] + counts["repeated"] + counts["absurd_command"]
        assert outcomes.total() + good == sum(1 for frame in frames if frame)
        assert counts["device_restarts"] == 0
        found = [(sample.sequence or 0) for sample in samples_of(messages)]
        if found:
            assert counts["samples"] + counts["lost_on_line"] == (found[-1] - found[0]) % 2**32 + 1
