"""Any bytes on the line: acquisition never raises, holds little, loses no valid frame and counts everything."""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Iterator

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fantwin.pipeline.config.models import TrayConfig
from fantwin.pipeline.sources.serial.config import SerialConfig
from fantwin.pipeline.sources.serial.port import ReceivedBytes
from fantwin.pipeline.sources.source import LinkDown, LinkUp
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


class NoLink(FakeLink):
    def write(self, data: bytes) -> bool:
        raise AssertionError("nothing is sent in these tests")


def make_core(protocol: Protocol, block_s: float = 0.0) -> SerialCore:
    tray = TrayConfig(name="bench", fans=FANS, source=SerialConfig(port="/dev/ttyTEST", protocol=protocol))
    core = SerialCore(tray, AcquisitionConfig(block_s=block_s), NoLink())
    core.step(LinkUp())
    return core


def make_pool(protocol: Protocol) -> list[tuple[Sample, bytes]]:
    chance = random.Random(1)
    pool = []
    for i in range(64):
        command = tuple(chance.randrange(1024) / 1024 for _ in range(FANS))
        speed = tuple(chance.randrange(1 << 20) / 1024 for _ in range(FANS))
        sample = Sample((2**32 - 100_000 + 10_000 * i) % 2**32, (FIRST_SEQUENCE + i) % 2**32, command, speed)
        pool.append((sample, encode(protocol, sample)))
    return pool


def spoil(frame: bytes, chance: random.Random) -> bytes:
    """A frame with one to three mutations."""
    data = bytearray(frame)
    for _ in range(chance.randint(1, 3)):
        at = chance.randrange(len(data)) if data else 0
        what = chance.randrange(6)
        if what == 0 and data:
            data[at] ^= 1 << chance.randrange(8)
        elif what == 1 and data:
            data[at] = chance.choice(b"\0\n\r #-SCP\xff" + bytes([chance.randrange(256)]))
        elif what == 2:
            del data[at : at + chance.randint(1, 8)]
        elif what == 3:
            data[at:at] = chance.randbytes(chance.randint(1, 8))
        elif what == 4:
            del data[at:]
        else:
            data[at:at] = data[: chance.randint(1, 20)]
    return bytes(data)


WELL_FORMED_BUT_NOT_WANTED = (
    CommandFrame((0.5,) * FANS),
    SetPointFrame((10.0,) * FANS),
    Sample(1, 1, (0.5,) * (FANS + 1), (1.0,) * (FANS + 1)),
    Sample(1, 1, (0.5, float("nan")), (1.0, 1.0)),
    Sample(1, 1, (0.5, 99.0), (1.0, 1.0)),
)


def noise(protocol: Protocol, chance: random.Random) -> bytes:
    what = chance.randrange(20)
    if what == 0:
        return chance.randbytes(1) * (MAX_FRAME_BYTES + chance.randint(-1, 100))
    if what == 1:
        return b"# a comment\n"
    if what < 7:
        return encode(protocol, chance.choice(WELL_FORMED_BUT_NOT_WANTED))
    return chance.randbytes(chance.randint(1, 40))


def make_stream(
    protocol: Protocol, pool: list[tuple[Sample, bytes]], chance: random.Random
) -> tuple[bytes, list[Sample]]:
    """A mutated stream, and the samples in it that were not mutated, in order."""
    stream, untouched = b"", []
    start = chance.randrange(len(pool) - 6)
    for sample, frame in pool[start : start + chance.randint(2, 6)]:
        if chance.random() < 0.3:
            stream += noise(protocol, chance)
        what = chance.randrange(10)
        if what < 6:
            hidden = protocol == "text" and stream[stream.rfind(b"\n") + 1 :].startswith(b"#")
            stream += frame  # after half a comment, a line of text is part of the comment
            if not hidden:
                untouched.append(sample)
                stream += frame if what == 0 else b""  # repeated
        elif what < 9:
            stream += spoil(frame, chance)
    return stream, untouched


def cut(stream: bytes, chance: random.Random) -> Iterator[bytes]:
    at = 0
    while at < len(stream):
        size = chance.choice((1, 7, 40, len(stream)))
        yield stream[at : at + size]
        at += size


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


def check_one_stream(protocol: Protocol, pool: list[tuple[Sample, bytes]], chance: random.Random) -> None:
    stream, untouched = make_stream(protocol, pool, chance)
    core = make_core(protocol, block_s=chance.choice((0.0, 0.05)))
    messages: list[Raw] = []
    for data in cut(stream, chance):
        messages += core.step(ReceivedBytes(data, 0))
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
        pieces = stream.split(b"\0")[:-1]
        good = counts["samples"] + counts["repeated"] + counts["absurd_command"]
        assert outcomes.total() + good == sum(1 for piece in pieces if piece)
        assert counts["device_restarts"] == 0
        found = [(sample.sequence or 0) for sample in samples_of(messages)]
        if found:
            assert counts["samples"] + counts["lost_on_line"] == (found[-1] - found[0]) % 2**32 + 1


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_mutated_streams_are_counted_to_the_last_frame(protocol: Protocol) -> None:
    chance, pool = random.Random(20), make_pool(protocol)
    for _ in range(300):
        check_one_stream(protocol, pool, chance)


@pytest.mark.parametrize("protocol", PROTOCOLS)
@given(pieces=st.lists(st.one_of(st.binary(max_size=64), st.none()), max_size=20))
def test_no_bytes_and_no_disconnection_make_the_core_raise(protocol: Protocol, pieces: list[bytes | None]) -> None:
    core = make_core(protocol)
    for i, piece in enumerate(pieces):
        if piece is None:
            core.step(LinkDown("gone"))
            core.step(LinkUp())
        else:
            for raw in core.step(ReceivedBytes(piece, i)):
                assert raw.speed_rad_s.shape == raw.command.shape == (len(raw.host_receive_t_ns), FANS)
        core.tick(i * 1_000_000_000)
        assert isinstance(core.problem(), str)
    core.close()
