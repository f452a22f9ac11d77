"""The firmware's parts without hardware: they agree with schemas/wire, and measure what they should."""

from __future__ import annotations

import ctypes
import math
from ctypes import POINTER, Structure, byref, c_bool, c_float, c_int, c_uint8, c_uint16, c_uint32
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fantwin.schemas.channels import SUPPLY_VOLTAGE
from fantwin.schemas.wire import DEVICE_COUNTERS, CommandFrame, Decoder, DeviceCounters, Sample, SetPointFrame, encode
from tests.support.firmware_build import parts_library

FANS = 4
PULSES = 2
PWM_STEPS = 640
COUNTERS = 12
COUNTERS_LINE_BYTES = 7 + 2 * COUNTERS + 4 + 3
SAMPLE_LINE_BYTES = 11 + 1 + 4 * FANS * 3 + 4 + 3
NOTHING, COMMAND, SET_POINT = range(3)
Values = c_float * FANS


class SampleStruct(Structure):
    """sample_t of frame.h."""

    _fields_ = (
        ("clock_us", c_uint32),
        ("sequence", c_uint32),
        ("command", Values),
        ("speed_rpm", Values),
        ("supply_v", c_float),
    )


class Receiver(Structure):
    """receiver_t of frame.h."""

    _fields_ = (("piece", c_uint8 * (3 + 4 * FANS + 4 + 1)), ("length", c_uint8), ("is_too_long", c_bool))


class TachoStruct(Structure):
    """tacho_t of tacho.h."""

    _fields_ = (
        ("edge_us", c_uint32 * (PULSES + 1)),
        ("level_since_us", c_uint32),
        ("pulses", c_uint16),
        ("glitches", c_uint16),
        ("newest", c_uint8),
        ("known", c_uint8),
        ("level", c_bool),
        ("settled_level", c_bool),
        ("has_stood", c_bool),
    )


class Fan(Structure):
    """fan_t of fan.h."""

    _fields_ = (("duty", c_float), ("set_point_rpm", c_float), ("integral", c_float), ("holds_speed", c_bool))


def firmware_parts(library: Path) -> ctypes.CDLL:
    """The functions of firmware/src, with the types of their headers."""
    parts = ctypes.CDLL(str(library))
    tacho, fan, octets = POINTER(TachoStruct), POINTER(Fan), POINTER(c_uint8)
    for name, result, arguments in (
        ("sample_encode", c_uint8, (POINTER(SampleStruct), octets)),
        ("counters_encode", c_uint8, (c_uint32, POINTER(c_uint16), octets)),
        ("receiver_take", c_int, (POINTER(Receiver), c_uint8, POINTER(c_float))),
        ("tacho_start", None, (tacho, c_bool, c_uint32)),
        ("tacho_edge", None, (tacho, c_bool, c_uint32)),
        ("tacho_settle", None, (tacho, c_uint32)),
        ("tacho_period_rpm", c_float, (tacho, c_uint32)),
        ("fan_start", None, (fan,)),
        ("fan_set_duty", None, (fan, c_float)),
        ("fan_set_speed", None, (fan, c_float, c_float)),
        ("fan_step", None, (fan, c_float)),
        ("fan_level", c_uint16, (fan,)),
    ):
        function = getattr(parts, name)
        function.restype, function.argtypes = result, arguments
    return parts


SPEED_MAX_RPM, GLITCH_US, STANDING_US, RATE_HZ = 20000.0, 100, 500_000, 50
UINT32 = 1 << 32


@pytest.fixture(scope="module")
def parts() -> ctypes.CDLL:
    return firmware_parts(parts_library())


# ---- frames

float32 = st.floats(width=32, allow_nan=True, allow_infinity=True)
duty = st.one_of(st.just(math.nan), st.floats(0.0, 1.0, width=32))
rpm = st.one_of(st.just(math.nan), st.floats(0.0, SPEED_MAX_RPM, width=32))


def of_each_fan(values: st.SearchStrategy[float]) -> st.SearchStrategy[tuple[float, ...]]:
    return st.lists(values, min_size=FANS, max_size=FANS).map(tuple)


@given(
    clock=st.integers(0, UINT32 - 1),
    sequence=st.integers(0, UINT32 - 1),
    command=of_each_fan(st.floats(0.0, 1.0, width=32)),
    speed=of_each_fan(rpm),
    supply=st.one_of(st.just(math.nan), st.floats(0.0, 30.0, width=32)),
)
def test_the_host_reads_the_sample_that_was_written(
    parts: ctypes.CDLL,
    clock: int,
    sequence: int,
    command: tuple[float, ...],
    speed: tuple[float, ...],
    supply: float,
) -> None:
    sample = SampleStruct(clock, sequence, Values(*command), Values(*speed), supply)
    line = (c_uint8 * SAMPLE_LINE_BYTES)()
    length = parts.sample_encode(byref(sample), line)
    (read,) = Decoder("binary", FANS).feed(bytes(line[:length]))
    assert isinstance(read, Sample)
    assert (read.clock_us, read.sequence, read.command) == (clock, sequence, command)
    assert read.speed == pytest.approx(speed, abs=0, nan_ok=True)
    assert read.measured[SUPPLY_VOLTAGE] == pytest.approx((supply,) * FANS, abs=0, nan_ok=True)


@given(
    uptime_s=st.integers(0, UINT32 - 1), counts=st.lists(st.integers(0, 65535), min_size=COUNTERS, max_size=COUNTERS)
)
def test_the_host_reads_the_counters_that_were_written(parts: ctypes.CDLL, uptime_s: int, counts: list[int]) -> None:
    line = (c_uint8 * COUNTERS_LINE_BYTES)()
    length = parts.counters_encode(uptime_s, (c_uint16 * COUNTERS)(*counts), line)
    assert Decoder("binary", FANS).feed(bytes(line[:length])) == [DeviceCounters(uptime_s, tuple(counts))]
    assert len(DEVICE_COUNTERS) == COUNTERS


def received(parts: ctypes.CDLL, data: bytes) -> list[tuple[int, tuple[float, ...]]]:
    """What the firmware makes of a stream: kinds, and the values of frames."""
    receiver, values, found = Receiver(), Values(), []
    for byte in data:
        kind = parts.receiver_take(byref(receiver), byte, values)
        if kind != NOTHING:
            found.append((kind, tuple(values) if kind in (COMMAND, SET_POINT) else ()))
    return found


@st.composite
def damaged_streams(draw: st.DrawFn) -> bytes:
    """Frames for this board and for others, whole and damaged, with noise between them."""
    stream = b""
    for _ in range(draw(st.integers(1, 6))):
        fans = draw(st.sampled_from((FANS, FANS, FANS, 1, 8)))
        values = tuple(draw(st.lists(st.one_of(duty, float32), min_size=fans, max_size=fans)))
        frame = draw(st.sampled_from((CommandFrame, SetPointFrame)))(values)
        piece = bytearray(encode("binary", frame))
        for at in draw(st.lists(st.integers(0, len(piece) - 1), max_size=2)):
            piece[at] ^= 1 << draw(st.integers(0, 7))
        stream += bytes(piece[draw(st.sampled_from((0, 0, 0, 3))) :]) + draw(st.binary(max_size=4))
    return stream + b"\0"


@given(stream=damaged_streams())
def test_the_firmware_takes_those_frames_that_the_protocol_takes(parts: ctypes.CDLL, stream: bytes) -> None:
    expected = []
    for frame in Decoder("binary", FANS, "device").feed(stream):
        if isinstance(frame, CommandFrame) and all(math.isnan(v) or 0.0 <= v <= 1.0 for v in frame.command):
            expected.append((COMMAND, frame.command))
        if isinstance(frame, SetPointFrame) and all(
            math.isnan(v) or 0.0 <= v <= SPEED_MAX_RPM for v in frame.set_point
        ):
            expected.append((SET_POINT, frame.set_point))
    taken = [item for item in received(parts, stream) if item[0] in (COMMAND, SET_POINT)]
    assert [kind for kind, _ in taken] == [kind for kind, _ in expected]
    for (_, values), (_, wanted) in zip(taken, expected, strict=True):
        assert values == pytest.approx(wanted, abs=0, nan_ok=True)


# ---- tachos


class Turning:
    """A tacho that is shown the pulses of a turning fan, from any time of the clock on."""

    def __init__(self, parts: ctypes.CDLL, start_us: int = 0) -> None:
        self._parts = parts
        self.tacho = TachoStruct()
        self.now_us = start_us
        parts.tacho_start(byref(self.tacho), True, start_us % UINT32)

    def edge(self, level: bool, after_us: float) -> None:
        self.now_us += round(after_us)
        self._parts.tacho_edge(byref(self.tacho), level, self.now_us % UINT32)

    def turn(self, pulses: int, period_us: float) -> None:
        """Even pulses."""
        for _ in range(pulses):
            for level in (False, True):
                self.edge(level, period_us / 2)

    def read(self, after_us: int = 0) -> float:
        self.now_us += after_us
        self._parts.tacho_settle(byref(self.tacho), self.now_us % UINT32)
        return self._parts.tacho_period_rpm(byref(self.tacho), self.now_us % UINT32)


def test_a_pulse_that_fails_to_come_lowers_the_speed_and_standstill_is_zero(parts: ctypes.CDLL) -> None:
    fan = Turning(parts)
    fan.turn(20, 10_000)
    in_half_a_pulse = 5_000 + 10_000 * 0.45
    assert fan.read(round(in_half_a_pulse) - 5_000) == pytest.approx(3000.0)
    assert fan.read(10_500) == pytest.approx(60e6 / 2 / 20_000, rel=1e-3)
    assert fan.read(100_000) == pytest.approx(60e6 / 2 / 120_000, rel=1e-3)
    assert fan.read(STANDING_US) == 0.0
    for _ in range(50):  # past the wrap of the clock it stays at rest
        assert fan.read(100_000_000) == 0.0
    fan.turn(PULSES + 1, 10_000)
    assert fan.read(GLITCH_US) == pytest.approx(3000.0)


# ---- what a fan is to do


@pytest.mark.parametrize(("full_rpm", "constant_s"), [(9000.0, 0.8), (2200.0, 1.0), (5000.0, 0.3)])
def test_the_speed_loop_reaches_its_set_point_without_a_large_overshoot(
    parts: ctypes.CDLL, full_rpm: float, constant_s: float
) -> None:
    fan, speed, highest = Fan(), full_rpm, 0.0
    parts.fan_start(byref(fan))
    for share in (0.4, 0.8):
        parts.fan_set_speed(byref(fan), share * full_rpm, speed)
        for _ in range(30 * RATE_HZ):
            parts.fan_step(byref(fan), speed)
            speed += (full_rpm * parts.fan_level(byref(fan)) / PWM_STEPS - speed) / constant_s / RATE_HZ
            highest = max(highest, speed)
        assert speed == pytest.approx(share * full_rpm, rel=0.01)
        highest = speed if share == 0.4 else highest
    assert highest < 0.9 * full_rpm


def test_the_speed_loop_ends_at_full_speed_if_the_fan_does_not_turn_or_is_not_seen(parts: ctypes.CDLL) -> None:
    fan = Fan()
    parts.fan_set_duty(byref(fan), 0.2)
    parts.fan_set_speed(byref(fan), 3000.0, 0.0)
    for _ in range(10 * RATE_HZ):
        parts.fan_step(byref(fan), 0.0)
    assert fan.duty == 1.0
    parts.fan_set_speed(byref(fan), 0.0, 0.0)
    parts.fan_step(byref(fan), 0.0)
    assert fan.duty == 0.0
    parts.fan_step(byref(fan), math.nan)
    assert fan.duty == 1.0
