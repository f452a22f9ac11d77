"""The serial wire protocol in both directions: frames to bytes and back, without any input or output.

A device sends samples; the host sends commands and set-points. There are two equivalent forms: `binary` (COBS, CRC-32)
and `text` (lines that any sketch can print); only the binary one has a frame for the counters of a device.
Numbers are float32 in both, so that decoding inverts encoding exactly for float32 values.
Reference: docs/reference/wire-protocol.md.
"""

from __future__ import annotations

import math
from typing import Literal, TypeAlias

from fantwin.schemas.channels import CHANNELS
from fantwin.schemas.wire.binary import decode_binary, encode_binary
from fantwin.schemas.wire.frames import (
    DEVICE_COUNTERS,
    MAX_FANS,
    UINT16,
    UINT32,
    CommandFrame,
    DeviceCounters,
    Fault,
    FaultKind,
    Frame,
    FrameError,
    Sample,
    SetPointFrame,
)
from fantwin.schemas.wire.text import LETTER, decode_text, encode_text

Protocol: TypeAlias = Literal["binary", "text"]
End: TypeAlias = Literal["host", "device"]
DELIMITERS: dict[Protocol, bytes] = {"binary": b"\0", "text": b"\n"}
"""between frames; one more is no frame and no fault"""

MAX_FRAME_BYTES = 16 * MAX_FANS * (2 + len(CHANNELS))
"""longest frame of both forms, 16 bytes for each number of a text line; it bounds the memory of a decoder"""


def encode(protocol: Protocol, frame: Frame) -> bytes:
    """Bytes of a frame with delimiters; `Decoder` turns them into the same frame in float32.

    In text, a command or set-point frame is one line for each fan that is not NaN, so possibly none.

    Raises:
        ValueError: no fans or more than 64, columns of different length, a clock or sequence outside 32 bits, or
            a binary sample without one of them; device counters outside 16 bits, too many of them, or in text.
    """
    if isinstance(frame, DeviceCounters):
        return _encode_counters(protocol, frame)
    fans = len(frame.set_point if isinstance(frame, SetPointFrame) else frame.command)
    if not 1 <= fans <= MAX_FANS:
        raise ValueError(f"{fans} fans; a frame carries 1 to {MAX_FANS}")
    if isinstance(frame, Sample):
        if any(len(column) not in (0, fans) for column in frame.measured.values()):
            raise ValueError(f"a column beside command and speed does not have {fans} values, one for each fan")
        for name, count in (("clock_us", frame.clock_us), ("sequence", frame.sequence)):
            if count is None and protocol == "binary":
                raise ValueError(f"{name} is missing; only a text sample may omit it")
            if count is not None and not 0 <= count < UINT32:
                raise ValueError(f"{name} = {count} does not fit 32 bits")
    return encode_binary(frame) if protocol == "binary" else encode_text(frame)


def _encode_counters(protocol: Protocol, frame: DeviceCounters) -> bytes:
    if protocol != "binary":
        raise ValueError("device counters have a binary form only")
    if len(frame.counts) > len(DEVICE_COUNTERS) or not all(0 <= count < UINT16 for count in frame.counts):
        raise ValueError(f"device counters are at most {len(DEVICE_COUNTERS)} numbers of 16 bits")
    if not 0 <= frame.uptime_s < UINT32:
        raise ValueError(f"uptime_s = {frame.uptime_s} does not fit 32 bits")
    return encode_binary(frame)


class Decoder:
    """Incremental parser for one end of a line: takes bytes as they arrive, gives frames and faults in order.

    It never raises and holds at most `MAX_FRAME_BYTES + 1` bytes between calls. The result does not depend on how the
    bytes are split into calls.
    """

    def __init__(self, protocol: Protocol, fans: int, end: End = "host") -> None:
        """Every frame must have `fans` fans. The end `host` accepts samples and counters of the device, `device`
        commands and set-points."""
        self._text = protocol == "text"
        self._delimiter = DELIMITERS[protocol]
        self._fans = fans
        self._accepts = (Sample, DeviceCounters) if end == "host" else (CommandFrame, SetPointFrame)
        self.reset()

    def reset(self) -> None:
        """Drop a partial frame after an interruption; the line may continue in the middle of another frame."""
        self._pending = b""
        self._joining = True

    def feed(self, data: bytes) -> list[Frame | Fault]:
        """The frames and faults that `data` completes."""
        *pieces, rest = (self._pending + data).split(self._delimiter)
        # Of a piece that is too long, keep the first byte (it may begin a comment) and the newest bytes (a frame may
        # begin there). Its length still shows that it is too long, however the stream is split.
        self._pending = rest if len(rest) <= MAX_FRAME_BYTES else rest[:1] + rest[-MAX_FRAME_BYTES:]
        found: list[Frame | Fault] = []
        for piece in pieces:
            found += self._decode_line(piece) if self._text else self._decode_piece(piece)
            self._joining = False
        return found

    def _decode_piece(self, piece: bytes) -> list[Frame | Fault]:
        if not piece:
            return []
        if len(piece) > MAX_FRAME_BYTES:
            return [self._fault(FaultKind.OVERSIZED, f"more than {MAX_FRAME_BYTES} bytes without an end")]
        try:
            return [self._checked(decode_binary(piece))]
        except FrameError as error:
            return [self._fault(error.fault.kind, error.fault.detail)]

    def _decode_line(self, line: bytes) -> list[Frame | Fault]:
        if line.startswith(b"#") or not line.strip():
            return []
        found: list[Frame | Fault] = []
        tail = line[-MAX_FRAME_BYTES:]
        starts = [match.start() for match in LETTER.finditer(tail)]
        before = tail[: starts[-1]] if starts else tail
        if len(line) > MAX_FRAME_BYTES:
            found.append(self._fault(FaultKind.OVERSIZED, f"more than {MAX_FRAME_BYTES} bytes without an end"))
        elif before.strip():
            found.append(self._fault(FaultKind.GARBAGE, f"{before[:24]!r} is not a line of this protocol"))
        if starts:
            try:
                found.append(self._checked(decode_text(tail[starts[-1] :], self._fans)))
            except FrameError as error:
                found.append(self._fault(error.fault.kind, error.fault.detail))
        return found

    def _checked(self, frame: Frame) -> Frame:
        """The frame, if it is for this end and tray."""
        if not isinstance(frame, self._accepts):
            raise FrameError(FaultKind.WRONG_TYPE, f"{type(frame).__name__} is not for this end of the line")
        if isinstance(frame, DeviceCounters):
            return frame
        fans = len(frame.set_point if isinstance(frame, SetPointFrame) else frame.command)
        if fans != self._fans:
            raise FrameError(FaultKind.WRONG_FAN_COUNT, f"frame of {fans} fans, this tray has {self._fans}")
        if isinstance(frame, Sample) and not all(map(math.isfinite, frame.command)):
            raise FrameError(FaultKind.BAD_COMMAND, "a sample's command is NaN or infinite")
        return frame

    def _fault(self, kind: FaultKind, detail: str) -> Fault:
        return Fault(FaultKind.RESYNC, detail) if self._joining else Fault(kind, detail)
