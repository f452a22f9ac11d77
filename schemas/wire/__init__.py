"""The serial wire protocol in both directions: frames to bytes and back, without any input or output.

A device sends samples; the host sends commands and set-points. There are two equivalent forms: `binary` (COBS, CRC-32)
and `text` (lines that any sketch can print); only the binary one has a frame for the counters of a device.
Numbers are float32 in both, so that decoding inverts encoding exactly for float32 values.
Reference: docs/reference/wire-protocol.md.
"""

from __future__ import annotations

from fantwin.schemas.wire.frames import (
    DEVICE_COUNTERS,
    MAX_FANS,
    UINT16,
    UINT32,
    VERSION,
    CommandFrame,
    DeviceCounters,
    Fault,
    FaultKind,
    Frame,
    Sample,
    SetPointFrame,
)
from fantwin.schemas.wire.stream import DELIMITERS, MAX_FRAME_BYTES, Decoder, End, Protocol, encode

__all__ = [
    "DELIMITERS",
    "DEVICE_COUNTERS",
    "MAX_FANS",
    "MAX_FRAME_BYTES",
    "UINT16",
    "UINT32",
    "VERSION",
    "CommandFrame",
    "Decoder",
    "DeviceCounters",
    "End",
    "Fault",
    "FaultKind",
    "Frame",
    "Protocol",
    "Sample",
    "SetPointFrame",
    "encode",
]
