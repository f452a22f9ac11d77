"""Healthy running of simulated fans, in the history that a learner keeps."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from fantwin.pipeline.learning.healthy_history import HealthyHistory
from fantwin.schemas.header import Header
from fantwin.schemas.messages import Raw
from fantwin.schemas.units import NS_PER_S
from tests.support.fan_data import published_run

START_S = 1_800_000_000
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
) -> None:
    """Two published fans under stairs from 0 to 100, from first_s after START_S on. factor: on their speeds. has_alarm:
    one of them has an alarm all the time."""
    history = HealthyHistory(folder, "site", "tray1", {"trays": "tray1"}, {}, hold_back_s=0.0, kept_s=1e9)
    run = published_run(seed, seconds, FANS)
    t_s, command, speed = (each[::KEPT_EVERY] for each in (run.t_s, run.command, run.speed_rad_s * np.array(factor)))
    for number, first in enumerate(range(0, len(t_s), 100)):
        rows = slice(first, first + 100)
        raw = Raw(
            header=Header("acquisition", number, "tray1"),
            fans=FANS,
            host_receive_t_ns=(START_S + first_s) * NS_PER_S + (t_s[rows] * NS_PER_S).astype(np.int64),
            command=command[rows],
            speed_rad_s=speed[rows],
        )
        history.add(raw, has_alarm=has_alarm, is_watched=False)
    history.close()
