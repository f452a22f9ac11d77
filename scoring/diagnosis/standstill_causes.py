"""Why a fan does not turn, or does not stop, as commanded.

A fan that loses its power coasts: from speed w its reading falls to that of a fan at rest in T log(w / w0), with the
time constant T of healthy coasts. The reading of a blocked fan falls at once, and so does that of a fan whose tacho or
whose whole connector is off. A tacho that averages blurs both by the time for which it holds a reading. How long the
fall took is compared with either, as a normal likelihood; where the two are alike, as at low speeds, each cause keeps
its prior probability. A fan that was never seen to turn under this command says nothing about the cause.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from schemas.standstill import Standstill
from schemas.tacho import Tacho
from scoring.diagnosis.diagnosis import Evidence, RankedCause
from scoring.diagnosis.regression_window import Array, HealthyBalance, Window
from scoring.diagnosis.shown_causes import BLOCKED, NO_POWER, NO_TACHO, STILL_DRIVEN, WINDMILLING

FELL_AT_ONCE = {BLOCKED: 0.5, NO_POWER: 0.05, NO_TACHO: 0.2}
"""prior probabilities of the faults after which the reading falls at once; no power: the connector is off"""
COASTED = 0.25
"""that of no power with the tacho alive"""
NEVER_TURNED = {BLOCKED: 0.4, NO_POWER: 0.4, NO_TACHO: 0.2}
NO_READING = {NO_TACHO: 0.8, NO_POWER: 0.15, BLOCKED: 0.05}
RAN_ON = {STILL_DRIVEN: 0.7, WINDMILLING: 0.3}
FALLING_SHARE = 0.85  # of the speed before: a lower reading belongs to the fall
BLUR_S = 0.15  # of the time of a fall, beside the tacho
COAST_SPREAD = 0.3  # standard deviation of a coast, relative to its expected time
MIN_COAST_S = 0.1
LEVEL_S = 10.0  # before the longest fall: readings of a healthy fan
RECENT_S = 1.0  # beyond the reach of the tacho
GRID = 200  # speeds at which the balance is inverted


def standstill_causes(
    window: Window, healthy: Standstill, balance: HealthyBalance, tacho: Tacho
) -> tuple[RankedCause, ...]:
    """The causes, most probable first, from a fan's last seconds up to the present; the onset is not used."""
    commands = window.command[np.isfinite(window.command)]
    command = float(commands[-1]) if len(commands) else math.nan
    speed = np.abs(window.speed_rad_s)
    if not command >= healthy.turning_command:
        return _ranked(RAN_ON, command, f"turns although the command of {command:.3g} stops it")
    turning = np.flatnonzero(healthy.turns(speed))
    recent = speed[-math.ceil((tacho.reach_s + RECENT_S) / window.period_s) :]
    sentence = f"does not turn although commanded to {command:.3g}"
    if np.isnan(recent).mean() > 0.5:
        return _ranked(NO_READING, command, f"gives no reading although commanded to {command:.3g}")
    if not len(turning) or not _was_driven(window, int(turning[-1]), healthy, tacho):
        return _ranked(NEVER_TURNED, command, sentence)
    fall_s, from_rad_s = _fall(window, int(turning[-1]), healthy, balance, tacho)
    constant_s = healthy.coast_time_constant_s
    if constant_s is None:
        return _ranked(_sums(FELL_AT_ONCE, COASTED), command, sentence)
    log = math.log(max(from_rad_s / healthy.standing_below_rad_s, 1.0))
    coast_s = max(constant_s * log, MIN_COAST_S)
    blur_s = tacho.held_s / 2 + window.period_s + BLUR_S
    at_once = _normal(fall_s, tacho.held_s / 2, blur_s)
    coasted = _normal(fall_s, coast_s + tacho.held_s / 2, math.hypot(blur_s, COAST_SPREAD * coast_s))
    likely = {cause: prior * at_once for cause, prior in FELL_AT_ONCE.items()}
    return _ranked(_sums(likely, COASTED * coasted), command, sentence)


def _was_driven(window: Window, last_turning: int, healthy: Standstill, tacho: Tacho) -> bool:
    """Whether the command turned the fan when it turned last, a reading's reach before included."""
    first = max(last_turning - math.ceil(tacho.reach_s / window.period_s), 0)
    command = window.command[first : last_turning + 1]
    known = command[np.isfinite(command)]
    return bool(len(known)) and bool(np.all(healthy.drives(known)))


def _fall(
    window: Window, last_turning: int, healthy: Standstill, balance: HealthyBalance, tacho: Tacho
) -> tuple[float, float]:
    """How long the reading took from that of a healthy fan to that of a fan at rest, s, and the speed it fell from.

    Readings are compared with the steady speed for their command, so that a moving command is not taken for the fall.
    """
    speed = np.abs(window.speed_rad_s[: last_turning + 1])
    share = speed / np.maximum(
        _steady_speed(window.command[: last_turning + 1], balance, speed), healthy.standing_below_rad_s
    )
    constant_s = healthy.coast_time_constant_s or 0.0
    longest_s = constant_s * math.log(np.nanmax(speed) / healthy.standing_below_rad_s) + tacho.reach_s
    before = max(len(speed) - math.ceil(longest_s / window.period_s), 0)
    reference = share[max(before - round(LEVEL_S / window.period_s), 0) : before]
    reference = reference[np.isfinite(reference)]
    level = float(np.median(reference)) if len(reference) else 1.0
    high = np.flatnonzero(share >= FALLING_SHARE * level)
    row = int(high[-1]) if len(high) else 0
    return (last_turning - row) * window.period_s, float(np.nanmax(speed[row:]))


def _steady_speed(command: Array, balance: HealthyBalance, speed_rad_s: Array) -> Array:
    """The speeds at which a healthy fan settles under commands, rad/s."""
    speeds = np.linspace(0.0, 2.0 * float(np.nanmax(speed_rad_s)), GRID)
    needed = balance.friction + balance.viscous * speeds + balance.drag * speeds**2
    return np.interp(command, np.maximum.accumulate(needed), speeds)


def _normal(value: float, mean: float, deviation: float) -> float:
    return math.exp(-0.5 * ((value - mean) / deviation) ** 2) / deviation + 1e-6


def _sums(causes: Mapping[str, float], no_power: float) -> dict[str, float]:
    return {**causes, NO_POWER: causes[NO_POWER] + no_power}


def _ranked(weights: Mapping[str, float], command: float, sentence: str) -> tuple[RankedCause, ...]:
    total = sum(weights.values())
    evidence = Evidence("command", command, command, command, "command") if math.isfinite(command) else None
    causes = [RankedCause(cause, weight / total, evidence, sentence) for cause, weight in weights.items()]
    return tuple(sorted(causes, key=lambda cause: -cause.probability))
