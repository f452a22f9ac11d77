"""Discovery of serial ports, and of the protocol and the fans of the device at one."""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from typing import TypeAlias

from fantwin.pipeline.errors import UserError
from fantwin.pipeline.sources.found import Found
from fantwin.pipeline.sources.serial.same_port import lasting_name, listed_ports
from fantwin.schemas import wire
from fantwin.schemas.wire.binary import decode_binary
from fantwin.schemas.wire.text import decode_text

LISTEN_S = 6.0
"""a microcontroller restarts when its port is opened, and sends its first sample after some seconds"""
_SAMPLES = 20
"""that are waited for: of all of them the largest command is known"""
_BAUD = 115200
_UNKNOWN = "n/a"
"""description by pyserial of a port of which the system knows no device"""
_COMMAND_RANGES = (1.0, 100.0, 255.0, 1000.0, 2000.0)
_FASTEST_RAD_S = 600.0
"""5,700 rpm: a larger speed is taken for one in rpm"""

Heard: TypeAlias = tuple[wire.Protocol, list[wire.Sample]]


def serial_ports() -> tuple[dict[str, str], list[str]]:
    """The ports with a known device, with its description, and all others."""
    listed = listed_ports()
    known = {each.device: each.description for each in listed if (each.description, each.hwid) != (_UNKNOWN, _UNKNOWN)}
    return known, [each.device for each in listed if each.device not in known]


def discover_device(port: str, listen_s: float = LISTEN_S) -> Found:
    """The [[tray]] of the device at a port, from what it sends; a guess where nothing is heard.

    Raises:
        UserError: the port cannot be opened.
    """
    heard = _heard(port, listen_s)
    if heard is None:
        note = (
            f"nothing of the protocol was heard in {listen_s:g} s at {_BAUD} baud: fans, protocol and unit are a guess"
        )
        return Found("serial", port, _tray(port, "text", 1, "rpm", 255.0), (note,))
    protocol, samples = heard
    commands = [abs(value) for sample in samples for value in sample.command]
    speeds = [abs(value) for sample in samples for value in sample.speed]
    unit = "rpm" if max(speeds, default=0.0) > _FASTEST_RAD_S else "rad/s"
    highest = next((each for each in _COMMAND_RANGES if max(commands) <= each), max(commands))
    note = (
        f"heard commands up to {max(commands):g} and speeds up to {max(speeds):g}: command_max and speed_unit follow "
    )
    tray = _tray(port, protocol, len(samples[-1].command), unit, highest)
    return Found("serial", port, tray, (f"{note}from these, correct them if they are wrong",))


def _tray(port: str, protocol: str, fans: int, unit: str, command_max: float) -> dict[str, object]:
    return {
        "name": "tray",
        "fans": fans,
        "speed_unit": unit,
        "command_max": command_max,
        "source": {"kind": "serial", "port": lasting_name(port), "protocol": protocol},
    }


def _heard(port: str, listen_s: float) -> Heard | None:
    import serial  # noqa: PLC0415  slow to import

    data, until_s = b"", time.monotonic() + listen_s
    try:
        with serial.Serial(port, _BAUD, timeout=0.1) as line:
            while time.monotonic() < until_s:
                data += line.read(4096)
                found = _samples(data)
                if found and len(found[1]) >= _SAMPLES:
                    break
    except (OSError, ValueError) as error:
        if not os.path.lexists(port):
            why = "no such port"
        elif os.access(port, os.R_OK | os.W_OK):
            why = "no serial port, or another program has it"
        else:
            why = "this user may not open it: join its group (often dialout)"
        raise UserError(f"{port}: {why}") from error
    return _samples(data)


def _samples(data: bytes) -> Heard | None:
    """The samples in what was received, and the form in which they are; None if there is none."""
    text = [line[line.rfind(b"S ") :] for line in data.split(b"\n")[1:-1] if b"S " in line]
    forms: Sequence[tuple[wire.Protocol, list[bytes]]] = (("binary", data.split(b"\0")[1:-1]), ("text", text))
    for protocol, pieces in forms:
        samples: list[wire.Sample] = []
        for piece in pieces:
            try:
                frame = decode_binary(piece) if protocol == "binary" else decode_text(piece, wire.MAX_FANS)
            except wire.FrameError:
                continue
            samples += [frame] if isinstance(frame, wire.Sample) else []
        if samples:
            return protocol, samples
    return None
