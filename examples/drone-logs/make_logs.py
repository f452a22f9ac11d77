"""Logs of three flights of a drone with four motors, as PX4 writes them (ULog), for trying."""

from __future__ import annotations

import math
import random
import struct
from pathlib import Path

MOTORS, RATE_HZ, FLIGHT_S = 4, 50, 90
J, ALPHA, C_D = 9e-5, 2e-4, 8e-7
"""J w' + ALPHA w + C_D w^2 = command, for w in rad/s: 1000 rad/s at full command"""
ESC = "int32_t esc_rpm;"
TOPICS = {
    "actuator_motors": "uint64_t timestamp;float[4] control;",
    "esc_status": "uint64_t timestamp;esc_report[4] esc;",
}


def record(kind: str, payload: bytes) -> bytes:
    """A message of the log: its length, its kind, its content."""
    return struct.pack("<HB", len(payload), ord(kind)) + payload


def turn(w: float, command: float, drag: float) -> float:
    """The speed of a motor one sample later."""
    for _ in range(10):
        w += (command - ALPHA * w - drag * C_D * w * w) / J / (10 * RATE_HZ)
    return w


def flight(path: Path, seed: int, *, is_damaged: bool = False) -> None:
    """The commands jump between a fifth and nine tenths, and the motors follow. Damaged: motor 2 needs more torque."""
    noise = random.Random(seed)
    log = [b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0), record("B", bytes(40))]
    log += [record("F", f"{name}:{fields}".encode()) for name, fields in {**TOPICS, "esc_report": ESC}.items()]
    log += [record("A", struct.pack("<BH", 0, number) + name.encode()) for number, name in enumerate(TOPICS)]
    command, w = [0.5] * MOTORS, [0.0] * MOTORS
    for k in range(FLIGHT_S * RATE_HZ):
        t_us = 1_000_000 + k * 1_000_000 // RATE_HZ
        rpm = [round(noise.gauss(speed * 30 / math.pi, 20)) for speed in w]
        command = [noise.uniform(0.2, 0.9) if noise.random() < 1 / RATE_HZ else each for each in command]
        log.append(record("D", struct.pack("<HQ4f", 0, t_us, *command)))
        log.append(record("D", struct.pack("<HQ4i", 1, t_us, *rpm)))
        drag = [1.25 if is_damaged and motor == 2 and k > 30 * RATE_HZ else 1.0 for motor in range(MOTORS)]
        w = [turn(*each) for each in zip(w, command, drag, strict=True)]
    path.write_bytes(b"".join(log))


if __name__ == "__main__":
    flight(Path("first.ulg"), 1)
    flight(Path("second.ulg"), 2)
    flight(Path("third.ulg"), 3, is_damaged=True)
