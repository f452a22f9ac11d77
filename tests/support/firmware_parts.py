"""The parts of the firmware that need no hardware, callable: what firmware/src declares, with types."""

from __future__ import annotations

import ctypes
from ctypes import POINTER, Structure, c_bool, c_float, c_int, c_uint8, c_uint16, c_uint32
from pathlib import Path

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
