"""The static curve: the speed a fan settles at under a command that stays, as measured and as the twin has it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from twin import physics
from twin.models import TwinModel
from twin.runs import Array, Run

SETTLED_TIME_CONSTANTS = 5.0
"""After so many, less than a hundredth of a step is left."""
SAME_COMMAND = 1e-3
"""A command holds while it changes by less than this share of its range from sample to sample, twice that in all."""
LEVELS = 41
STEADY_TIME_CONSTANTS = 20.0
MOST_STEPS = 20_000


@dataclass(frozen=True, eq=False)
class StaticCurve:
    """One fan's. measured: (holds, 2) command and mean speed in rad/s; twin: (LEVELS, 2), NaN where it diverges."""

    measured: Array
    twin: Array


def static_curve(
    model: TwinModel, parameters: Array, pieces: Sequence[Run], fan: int, rate_hz: float, top_speed_rad_s: float
) -> StaticCurve:
    """The curve of one fan with the physical parameters (parameters of that fan alone).

    rate_hz: the rate at which the twin is stepped. top_speed_rad_s: the largest in training; sets how long the twin is
    given to settle.
    """
    commands = np.concatenate([piece.command[:, fan] for piece in pieces])
    low, high = float(commands.min()), float(commands.max())
    measured = [
        level for piece in pieces for level in _steady_levels(piece, fan, parameters, SAME_COMMAND * (high - low))
    ]
    levels = np.linspace(low, high, LEVELS)
    settle_s = STEADY_TIME_CONSTANTS * settling_time_constant_s(0.25 * top_speed_rad_s, parameters)
    steps = int(min(max(settle_s * rate_hz, 1.0), MOST_STEPS))
    command = np.tile(levels, (steps, 1))
    start = np.full(LEVELS, 0.5 * top_speed_rad_s)
    with np.errstate(all="ignore"):
        speed_rad_s, _ = model.advance(
            model.state_layout.initial_state(start, command[0]),
            command,
            np.full(steps, 1.0 / rate_hz),
            np.tile(parameters, (LEVELS, 1)),
        )
    steady = np.where(np.isfinite(speed_rad_s[-1]), speed_rad_s[-1], np.nan)
    return StaticCurve(np.array(measured).reshape(-1, 2), np.column_stack((levels, steady)))


def settling_time_constant_s(speed_rad_s: float, parameters: Array) -> float:
    """Of one fan's physics around a speed, the lag of its drive included; infinite where the physics do not settle."""
    with np.errstate(divide="ignore"):
        mechanical_s = float(physics.time_constant_s(np.array([speed_rad_s]), parameters[np.newaxis])[0])
    named = dict(zip(physics.PARAMETER_NAMES, parameters.tolist(), strict=True))
    return mechanical_s + named.get("lag_s", 0.0) if mechanical_s > 0.0 else np.inf


def _steady_levels(piece: Run, fan: int, parameters: Array, tolerance: float) -> list[tuple[float, float]]:
    """Command and mean speed of each hold of a piece that lasted long enough to settle, over its settled part."""
    command, speed_rad_s = piece.command[:, fan], piece.speed_rad_s[:, fan]
    changes = np.flatnonzero(np.abs(np.diff(command)) > tolerance) + 1
    levels = []
    for part in np.split(np.arange(piece.samples), changes):
        held = speed_rad_s[part]
        last = held[len(held) // 2 :]
        drifts = np.ptp(command[part]) > 2.0 * tolerance
        if drifts or not np.isfinite(last).any():
            continue
        wait_s = SETTLED_TIME_CONSTANTS * settling_time_constant_s(float(np.nanmean(last)), parameters)
        settled = held[piece.t_s[part] >= piece.t_s[part[0]] + wait_s]
        if np.isfinite(settled).any():
            levels.append((float(command[part].mean()), float(np.nanmean(settled))))
    return levels
