"""The static curve: the speed at which a fan settles under a held command, as measured and as predicted by the twin."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fantwin.twin.models import physics
from fantwin.twin.models.model import MayBeStatic, TwinModel
from fantwin.twin.runs import Array, Run

SETTLED = 0.01
"""A fan has settled when the rest of its step is less than this share of its top speed."""
FEWEST_TIME_CONSTANTS = 1.0
"""A smaller step is hidden by noise."""
ENDS = 0.1
"""Share of a hold, at its beginning and its end, over which the speeds of the step are averaged."""
SAME_COMMAND = 1e-3
"""A command holds while it changes by less than this share of its range from sample to sample, twice that in all."""
LEVELS = 41
STEADY_TIME_CONSTANTS = 20.0
MOST_STEPS = 20_000


@dataclass(frozen=True)
class Hold:
    """A held command, for lasted_s; needed_s is the time that the fan, and its tacho, take to settle.

    speed_rad_s: the mean from there on, NaN where the hold was too short or nothing was measured.
    """

    command: float
    lasted_s: float
    needed_s: float
    speed_rad_s: float


@dataclass(frozen=True, eq=False)
class StaticCurve:
    """One fan's. twin: (LEVELS, 2) command and settled speed in rad/s, NaN where it diverges."""

    holds: tuple[Hold, ...]
    twin: Array

    @property
    def measured(self) -> Array:
        """(n, 2) command and mean speed in rad/s of the holds in which the fan settled."""
        settled = [(hold.command, hold.speed_rad_s) for hold in self.holds if np.isfinite(hold.speed_rad_s)]
        return np.array(settled).reshape(-1, 2)


def static_curve(
    model: TwinModel, parameters: Array, pieces: Sequence[Run], fan: int, rate_hz: float, top_speed_rad_s: float
) -> StaticCurve:
    """The curve of one fan with the physical parameters (parameters of that fan alone).

    rate_hz: the rate at which the twin is stepped. top_speed_rad_s: the largest in training; says what is settled, and
    how long the twin is given.
    """
    commands = np.concatenate([piece.command[:, fan] for piece in pieces])
    low, high = float(commands.min()), float(commands.max())
    tolerance = SAME_COMMAND * (high - low)
    holds = [hold for piece in pieces for hold in _holds(piece, fan, parameters, tolerance, top_speed_rad_s)]
    levels = np.linspace(low, high, LEVELS)
    if isinstance(model, MayBeStatic) and (curve := model.steady_curve(parameters[np.newaxis])) is not None:
        return StaticCurve(tuple(holds), np.column_stack((levels, curve.speed_rad_s(levels[:, np.newaxis])[:, 0])))
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
    return StaticCurve(tuple(holds), np.column_stack((levels, steady)))


def settling_time_constant_s(speed_rad_s: float, parameters: Array) -> float:
    """Of one fan's physics around a speed, the lag of its drive included; infinite where the physics do not settle."""
    mechanical_s = float(physics.time_constant_s(np.array([speed_rad_s]), parameters[np.newaxis])[0])
    return mechanical_s + float(parameters[physics.LAG]) if mechanical_s > 0.0 else np.inf


def _holds(piece: Run, fan: int, parameters: Array, tolerance: float, top_speed_rad_s: float) -> list[Hold]:
    """The stretches of a piece over which the command stayed and a speed was measured at both ends."""
    command, speed_rad_s = piece.command[:, fan], piece.speed_rad_s[:, fan]
    changes = np.flatnonzero(np.abs(np.diff(command)) > tolerance) + 1
    holds = []
    for part in np.split(np.arange(piece.samples), changes):
        end = max(1, round(ENDS * len(part)))
        speeds = speed_rad_s[part]
        drifts = np.ptp(command[part]) > 2.0 * tolerance
        if len(part) < 2 or drifts or not (np.isfinite(speeds[:end]).any() and np.isfinite(speeds[-end:]).any()):
            continue
        age_s = piece.t_s[part] - piece.t_s[part[0]]
        ends_rad_s = float(np.nanmean(speeds[:end])), float(np.nanmean(speeds[-end:]))
        settling_s = _settling_s(*ends_rad_s, float(age_s[-1]), parameters, SETTLED * top_speed_rad_s)
        needed_s = settling_s + piece.tacho[fan].reach_s
        settled = speeds[(age_s >= needed_s) & np.isfinite(speeds)]
        mean_rad_s = float(settled.mean()) if settled.size else np.nan
        holds.append(Hold(float(command[part].mean()), float(age_s[-1]), needed_s, mean_rad_s))
    return holds


def _settling_s(first_rad_s: float, last_rad_s: float, lasted_s: float, parameters: Array, left_rad_s: float) -> float:
    """Until no more than left_rad_s is left of a step, of which a hold has shown the way from first to last.

    Drag slows a fan that rises less at first: the time constant is that of the slower of the middle and the end.
    """
    slower_rad_s = min(last_rad_s, 0.5 * (first_rad_s + last_rad_s))
    time_constant_s = settling_time_constant_s(slower_rad_s, parameters)
    if not np.isfinite(time_constant_s):
        return np.inf
    step_rad_s = abs(last_rad_s - first_rad_s) / -np.expm1(-lasted_s / time_constant_s)
    return time_constant_s * max(float(np.log1p(step_rad_s / left_rad_s)), FEWEST_TIME_CONSTANTS)
