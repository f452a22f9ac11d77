"""Healthy recordings of fans under commands that a test chooses, in the history that a learner keeps."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.signal import lfilter

from fantwin.pipeline.learning.healthy_history import HealthyHistory
from fantwin.schemas.header import Header
from fantwin.schemas.messages import Array, Raw
from fantwin.schemas.units import NS_PER_S

START_S = 1_800_000_000
RATE_HZ = 5.0
HELD = 40.0
LEVEL_S = 10.0
GAIN, NOISE_RAD_S = 3.0, 0.5
SAMPLES_PER_MESSAGE = 50


def held(seconds: float, fans: int = 2) -> Array:
    """(samples, fans) one command."""
    return np.full((round(seconds * RATE_HZ), fans), HELD)


def moving(seconds: float, fans: int = 2, seed: int = 1) -> Array:
    """(samples, fans) each fan at another command every ten seconds."""
    levels = np.random.default_rng(seed).uniform(10.0, 100.0, (round(seconds / LEVEL_S), fans))
    return np.repeat(levels, round(LEVEL_S * RATE_HZ), axis=0)


def recorded(folder: Path, first_s: float, command: Array, rate_hz: float = RATE_HZ) -> None:
    """Add a recording of fans with a time constant of a second, from first_s after START_S on."""
    decay = np.exp(-1.0 / rate_hz)
    speed, _ = lfilter([0.0, 1.0 - decay], [1.0, -decay], GAIN * command, axis=0, zi=GAIN * command[:1])
    speed += np.random.default_rng(len(command)).normal(0.0, NOISE_RAD_S, speed.shape)
    add_history(folder, first_s, command, speed, rate_hz)


def add_history(
    folder: Path, first_s: float, command: Array, speed_rad_s: Array, rate_hz: float, *, has_alarm: bool = False
) -> None:
    """Add a recording to the history of a tray. command, speed_rad_s: (samples, fans). has_alarm: one of the fans has
    an alarm all the time."""
    history = HealthyHistory(folder, "site", "tray1", {"trays": "tray1"}, {}, hold_back_s=0.0, kept_s=1e9)
    t_ns = round((START_S + first_s) * NS_PER_S) + (np.arange(len(command)) / rate_hz * NS_PER_S).astype(np.int64)
    for number, first in enumerate(range(0, len(command), SAMPLES_PER_MESSAGE)):
        rows = slice(first, first + SAMPLES_PER_MESSAGE)
        columns = {"host_receive_t_ns": t_ns[rows], "command": command[rows], "speed_rad_s": speed_rad_s[rows]}
        raw = Raw(header=Header("acquisition", number, "tray1"), fans=command.shape[1], **columns)
        history.add(raw, has_alarm=has_alarm, is_watched=False)
    history.close()
