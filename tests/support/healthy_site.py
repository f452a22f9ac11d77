"""Recordings of simulated fans of a plant. Each seed has times of its own, as the recordings of a plant have."""

from __future__ import annotations

from pathlib import Path

from schemas.units import NS_PER_S
from tests.support.fan_data import published_run
from tests.support.written_recordings import write_run
from twin.runs import Run

EPOCH_NS = 1_790_000_000 * NS_PER_S
FANS = 2
KEPT_EVERY = 5
"""sample of the simulation: 20 Hz, which is scored in a fifth of the time"""
PER_DAY = 1500
"""false alarms that are declared: as few as two minutes can support"""
FAULT_S = (20, 50)
"""of the last fan of a recording that has a fault"""


def start_ns(seed: int) -> int:
    """The first time in the recording of a seed."""
    return EPOCH_NS + seed * 1_000 * NS_PER_S


def recorded(path: Path, seed: int, seconds: float, *, fans: int = FANS, has_fault: bool = False) -> Path:
    """Published fans under stairs, the last of which turns at 0.4 of its speed during a fault."""
    run = published_run(seed, seconds, fans)
    t_s, command, speed_rad_s = (each[::KEPT_EVERY].copy() for each in (run.t_s, run.command, run.speed_rad_s))
    if has_fault:
        speed_rad_s[(t_s >= FAULT_S[0]) & (t_s < FAULT_S[1]), -1] *= 0.4
    return write_run(path, Run(run.name, t_s + start_ns(seed) / NS_PER_S, command, speed_rad_s))
