"""Healthy running of simulated fans, in the history that a learner keeps."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tests.support.commanded_fans import START_S, add_history
from tests.support.fan_data import RATE_HZ, published_run

__all__ = ["FANS", "START_S", "add_recording"]

FANS = 2
KEPT_EVERY = 5
"""sample of the simulation: 20 Hz, so that training takes seconds"""


def add_recording(
    folder: Path,
    first_s: int,
    seconds: float,
    seed: int,
    factor: tuple[float, float] = (1.0, 1.0),
    *,
    has_alarm: bool = False,
    every: int = KEPT_EVERY,
) -> None:
    """Two published fans under stairs from 0 to 100, from first_s after START_S on. factor: on their speeds. has_alarm:
    one of them has an alarm all the time. every: which samples of the simulation are kept."""
    run = published_run(seed, seconds, FANS)
    command, speed = (each[::every] for each in (run.command, run.speed_rad_s * np.array(factor)))
    add_history(folder, first_s, command, speed, RATE_HZ / every, has_alarm=has_alarm)
