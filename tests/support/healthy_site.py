"""Recordings of simulated fans of a plant. Each seed has times of its own, as the recordings of a plant have."""

from __future__ import annotations

from pathlib import Path

from fantwin.schemas.units import NS_PER_S
from fantwin.twin.evaluation.resampling import thinned
from fantwin.twin.runs import Run
from tests.support.fan_data import published_run
from tests.support.written_recordings import write_run

EPOCH_NS = 1_790_000_000 * NS_PER_S
FANS = 2
HEALTHY_S, OTHER_S = 60, 30
"""length of the recording of the calibration, and of each of the others"""
PER_DAY = 3000
"""false alarms that are declared: as few as a minute can support"""
FAULT_S = (10, 25)
"""begin and end of the fault of the last fan of a recording that has one"""


def start_ns(seed: int) -> int:
    """The first time in the recording of a seed."""
    return EPOCH_NS + seed * 1_000 * NS_PER_S


def recorded(
    path: Path,
    seed: int,
    seconds: float,
    *,
    fans: int = FANS,
    has_fault: bool = False,
    fault_s: tuple[int, int] = FAULT_S,
) -> Path:
    """Published fans under stairs, the last of which turns at 0.4 of its speed during a fault."""
    run = thinned(published_run(seed, seconds, fans), 5)  # 20 Hz, which is scored in a fifth of the time
    speed_rad_s = run.speed_rad_s.copy()
    if has_fault:
        speed_rad_s[(run.t_s >= fault_s[0]) & (run.t_s < fault_s[1]), -1] *= 0.4
    return write_run(path, Run(run.name, run.t_s + start_ns(seed) / NS_PER_S, run.command, speed_rad_s))
