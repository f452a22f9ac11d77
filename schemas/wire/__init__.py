"""The serial wire protocol in both directions: frames to bytes and back, without any input or output.

A device sends samples; the host sends commands and set-points. There are two equivalent forms: `binary` (COBS, CRC-32)
and `text` (lines that any sketch can print). Numbers are float32 in both, so that decoding inverts encoding exactly for
float32 values. Reference: docs/reference/wire-protocol.md.
"""

from __future__ import annotations

from schemas.wire.frames import (
    MAX_FANS,
    UINT32,
    VERSION,
    CommandFrame,
    Fault,
    FaultKind,
    Frame,
    Sample,
    SetPointFrame,
)
from schemas.wire.stream import DELIMITERS, MAX_FRAME_BYTES, Decoder, End, Protocol, encode

__all__ = [
    "DELIMITERS",
    "MAX_FANS",
    "MAX_FRAME_BYTES",
    "UINT32",
    "VERSION",
    "CommandFrame",
    "Decoder",
    "End",
    "Fault",
    "FaultKind",
    "Frame",
    "Protocol",
    "Sample",
    "SetPointFrame",
    "encode",
]
