"""Why a fan does not turn, or does not stop, as commanded.

A fan without power coasts. A held rotor stops within a reading or two, and a tacho without signal reads as if it did.
The *area* of the fall tells them apart: the integral of the share of the speed that is left, in seconds at full speed.
The first reading of the fall is a mean that contains full speed, so only the later ones count.

    held rotor    exponential, a small share of a coast; one in ten is only braked: any share of a coast
    lost signal   as for a held rotor
    no power      lognormal around a healthy coast; with the plug off, as for a lost signal

A fan that was never seen to turn under this command says nothing about the cause: the priors remain.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import Enum

from fantwin.schemas.messages import Diagnosis
from fantwin.schemas.units import short_number
from fantwin.scoring.diagnosis.causes import (
    BLOCKED,
    MIN_PROBABILITY,
    NO_POWER,
    NO_TACHO,
    STILL_DRIVEN,
    WINDMILLING,
)


class Standing(Enum):
    """Behaviour of a fan against its command."""

    CAME_TO_REST = "does not turn"
    NOT_STARTED = "has not started"
    NO_READING = "gives no reading"
    KEEPS_SPEED = "keeps its speed"
    COASTS_TOO_LONG = "turns"
    TURNED_AGAIN = "turns again"


DOES_NOT_TURN = {BLOCKED: 0.4, NO_POWER: 0.4, NO_TACHO: 0.2}
RUNS_ON = {STILL_DRIVEN: 0.7, WINDMILLING: 0.3}
PRIORS = {
    Standing.CAME_TO_REST: DOES_NOT_TURN,
    Standing.NOT_STARTED: DOES_NOT_TURN,
    Standing.NO_READING: {NO_TACHO: 0.8, NO_POWER: 0.15, BLOCKED: 0.05},
    Standing.KEEPS_SPEED: RUNS_ON,
    Standing.COASTS_TOO_LONG: RUNS_ON,
    Standing.TURNED_AGAIN: RUNS_ON,
}
UNPLUGGED = 0.1
"""share of no power in which the whole connector is off, with the tacho"""
HELD, BRAKED = 0.05, 0.1
"""share of a coast that a held rotor turns; share of blocked rotors that are only braked"""
BEGUN = 0.85
"""share of the speed below which a reading belongs to a fall"""
COAST, COAST_SPREAD = 0.92, 0.25
"""median area of a coast down to the reading of a fan at rest, share of a whole coast; and spread of its logarithm"""
PHASES, HALVINGS = 20, 20
"""number of phases of a reading at which a fall may begin, and steps of a bisection"""
LEAST_HELD_S = 0.02
LEAST_DENSITY = 1e-3
"""density per coast of a fall longer than any cause explains; no power gets it"""


@dataclass(frozen=True)
class Fall:
    """Fall of a fan to rest, by its readings below BEGUN and above rest.

    lasted_s: integral of the share of the expected speed that they show, s; rest_s: that of all but the first one;
    coasts_s: that of a whole healthy coast without power; held_s: how long a reading is held, at least the time between
    two.
    """

    lasted_s: float
    rest_s: float
    coasts_s: float
    held_s: float


def standstill_causes(standing: Standing, fall: Fall | None, command: float = math.nan) -> tuple[Diagnosis, ...]:
    """The causes, the most probable first. fall: None where none was seen; command: NaN leaves it out of the words."""
    weights, words = PRIORS[standing], standing.value
    is_known = math.isfinite(command)
    if weights is RUNS_ON:
        words = f"{words} although {f'the command of {short_number(command)}' if is_known else 'its command'} stops it"
    else:
        words = f"{words} although commanded to {short_number(command) if is_known else 'turn'}"
    if standing == Standing.CAME_TO_REST and fall is not None and fall.coasts_s > 0.0:
        weights = _weighed(weights, fall)
        words = f"{words}; it ran on for {fall.lasted_s:.1f} s, without power it would for {fall.coasts_s:.1f} s"
    total = sum(weights.values())
    ranked = sorted(((weight / total, cause) for cause, weight in weights.items()), key=lambda each: -each[0])
    least = min(MIN_PROBABILITY, ranked[0][0])
    change = {"parameter": "command", "change": command, "unit": "command"} if is_known else {}
    return tuple(
        Diagnosis(cause=cause, probability=probability, evidence=words, **change)
        for probability, cause in ranked
        if probability >= least
    )


def _weighed(priors: Mapping[str, float], fall: Fall) -> dict[str, float]:
    """Priors times the densities of the rest of the fall, in coasts. Below HELD all are alike."""
    rest, tacho = fall.rest_s / fall.coasts_s, max(fall.held_s, LEAST_HELD_S) / fall.coasts_s
    at_once = _density(_stopped, HELD, rest, tacho)
    braked = _density(_braked, 0.5, rest, tacho)
    coasts = _density(_coasted, 1.0, rest, tacho)
    return {
        BLOCKED: priors[BLOCKED] * ((1.0 - BRAKED) * at_once + BRAKED * braked),
        NO_POWER: priors[NO_POWER] * ((1.0 - UNPLUGGED) * coasts + UNPLUGGED * at_once + LEAST_DENSITY),
        NO_TACHO: priors[NO_TACHO] * at_once,
    }


def _density(area: Callable[[float], float], constant: float, rest: float, tacho: float) -> float:
    """Density of the rest of a fall, from the distribution of its area, as a mean over the phases of a reading.

    The first reading of the fall ends within the time of one after the fall begins; where it is too high to belong to
    the fall, the next is the first. constant: usual time constant of the fall.
    """
    low, high = (0.0, HELD) if rest < HELD else (rest - 0.5 * HELD, rest + 0.5 * HELD)
    total = 0.0
    for number in range(PHASES):
        phase = (number + 0.5) / PHASES
        turned = -constant * math.expm1(-(1.0 - phase) * tacho / constant)
        belongs = phase + turned / tacho < BEGUN
        until = (1.0 - phase if belongs else 2.0 - phase) * tacho
        total += area(_area_with(high, until)) - (area(_area_with(low, until)) if low > 0.0 else 0.0)
    return total / (PHASES * HELD)


def _area_with(rest: float, until: float) -> float:
    """Area of an exponential fall that has `rest` left after `until`: area exp(-until / area) = rest."""
    low, high = rest, rest + 2.0 * until
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if middle * math.exp(-until / middle) < rest else (low, middle)
    return 0.5 * (low + high)


def _stopped(share: float) -> float:
    """Probability that a held rotor turns at most a share of a healthy coast."""
    return -math.expm1(-max(share, 0.0) / HELD)


def _braked(share: float) -> float:
    """Probability that a braked rotor turns at most a share of a healthy coast."""
    return min(max(share, 0.0), 1.0)


def _coasted(share: float) -> float:
    """Probability that a coasting rotor turns at most a share of a healthy coast."""
    return 0.5 * math.erfc(-math.log(share / COAST) / COAST_SPREAD / math.sqrt(2.0)) if share > 0.0 else 0.0
