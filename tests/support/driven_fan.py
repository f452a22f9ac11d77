"""A made run of a counted fan behind a drive that stops it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fantwin.schemas.tacho import Tacho
from fantwin.twin.models.drive import Drive
from fantwin.twin.models.physical import PhysicalModel
from fantwin.twin.runs import Run
from fantwin.twin.tacho_readings import measurement_of

DRIVE = Drive(turning_command=10.0, kick_s=0.6, rest_s=2.0)
PHYSICS = np.array([[0.35, 0.25, 5e-4, 0.0]])
SETTINGS = np.array([[50.0, 10.0, 180.0]])
RATE_HZ, HOLD_S = 10.0, 12.0


def run_of(drive: Drive | None, seed: int) -> Run:
    """Eight minutes of a counted fan whose command jumps; every fifth one stops it."""
    rng = np.random.default_rng(seed)
    levels = rng.choice([20.0, 30.0, 45.0, 70.0, 110.0, 160.0, 220.0, 255.0], 40)
    levels[4::5] = 0.0
    command = np.repeat(levels, round(HOLD_S * RATE_HZ))[:, np.newaxis]
    t_s = np.arange(len(command)) / RATE_HZ
    model = PhysicalModel() if drive is None else PhysicalModel().with_drive(drive)
    parameters = PHYSICS if drive is None else np.hstack((PHYSICS, SETTINGS))
    state = model.state_layout.initial_state(np.array([100.0]), command[0])
    speed, _ = model.advance(state, command, np.full(len(t_s), 1.0 / RATE_HZ), parameters)
    run = Run("made", t_s, command, speed, (Tacho(kind="count", window_s=0.5),))
    noise = rng.normal(0.0, run.tacho[0].resolution_rad_s / np.sqrt(6.0), speed.shape)
    return replace(run, speed_rad_s=np.maximum(measurement_of(run).of_speed(speed) + noise, 0.0))
