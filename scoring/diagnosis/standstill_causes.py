"""Why a fan does not turn, or does not stop, as commanded.

A fan that loses its power coasts: from speed w its reading falls to that of a fan at rest in T log(w / w0), with the
time constant T of healthy coasts. The reading of a blocked fan falls at once, and so does that of a fan whose tacho or
whose whole connector is off. The course of the readings is compared with what the tacho would show of either, whenever
the fall and the tacho's windows began. Where the data do not tell them apart, blocked and no power are about equally
probable. A fan that was never seen to turn under this command says nothing about the cause.

Before it stands, its readings may as well be of a fan that slows down to another speed: of all such speeds, as fast as
a fan coasts or at once. How probable that is belongs to the causes of a fan that turns.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import ndtr

from schemas.standstill import Standstill
from schemas.tacho import Tacho
from scoring.diagnosis.diagnosis import CANNOT_TELL, CANNOT_TELL_YET, Evidence, RankedCause
from scoring.diagnosis.regression_window import Array, HealthyBalance, Window
from scoring.diagnosis.shown_causes import BLOCKED, FALLING, NO_POWER, NO_TACHO, STILL_DRIVEN, WINDMILLING
from scoring.diagnosis.supply_evidence import supply_in_words, weighed_by_supply

FELL_AT_ONCE = {BLOCKED: 0.4, NO_POWER: 0.04, NO_TACHO: 0.2}
"""prior probabilities of the faults after which the reading falls at once; no power: the connector is off"""
COASTED = 0.36
"""that of no power with the tacho alive"""
NEVER_TURNED = {BLOCKED: 0.4, NO_POWER: 0.4, NO_TACHO: 0.2}
NO_READING = {NO_TACHO: 0.8, NO_POWER: 0.15, BLOCKED: 0.05}
RAN_ON = {STILL_DRIVEN: 0.7, WINDMILLING: 0.3}
FALLING_SHARE = 0.85  # of the speed before: a lower reading belongs to the fall
AT_ONCE_S = 0.03
"""time constant of a blocked fan"""
COAST_FACTORS = np.array([0.7, 1.0, 1.4])
"""of the typical time constant, those of other fans and speeds"""
LONGEST_COASTS = 1.4
FALLS, PHASES = 60, 6
"""how many times of the fall, and of a window of the tacho, are tried"""
READING_ERROR = 0.1
"""standard deviation of a reading beside its resolution, in the speed before the fall"""
LEAST_LIKELIHOOD = 1e-6
COMES_TO_REST = 0.5
"""prior probability that a fan whose reading falls comes to rest, and does not slow down to another speed"""
SAME_ERROR_S = 0.2
"""a coast is not quite exponential: readings within this time of a fan that still turns are off alike"""
SAMPLES_OF_AN_ERROR = 4
LOSS_STD = 0.25
"""prior standard deviation of the share of its speed that a fan loses if it slows down"""
UNCLEAR = f"{CANNOT_TELL_YET}: it slows down, and more is known when it stands or turns evenly"
LEVEL_S = 10.0  # before the longest fall: readings of a healthy fan
RECENT_S = 1.0  # beyond the reach of the tacho
GRID = 200  # speeds at which the balance is inverted


def standstill_causes(
    window: Window, healthy: Standstill, balance: HealthyBalance, tacho: Tacho
) -> tuple[RankedCause, ...]:
    """The causes, most probable first, from a fan's last seconds up to the present; the onset is not used."""
    window = window.as_given
    commands = window.command[np.isfinite(window.command)]
    command = float(commands[-1]) if len(commands) else math.nan
    given, speed = _of_command(command), np.abs(window.speed_rad_s)
    if not command >= healthy.turning_command:
        return _ranked(RAN_ON, given, f"turns although the command of {command:.3g} stops it")
    turning = np.flatnonzero(healthy.turns(speed))
    recent = speed[-math.ceil((tacho.reach_s + RECENT_S) / window.period_s) :]
    supply = supply_in_words(window)
    sentence = f"does not turn although commanded to {command:.3g}{supply}"

    def ranked(weights: Mapping[str, float], because: str = sentence) -> tuple[RankedCause, ...]:
        return _ranked(weighed_by_supply(weights, window), given, because)

    if np.isnan(recent).mean() > 0.5:
        return ranked(NO_READING, f"gives no reading although commanded to {command:.3g}{supply}")
    if not len(turning) or not _was_driven(window, int(turning[-1]), healthy, tacho):
        return ranked(NEVER_TURNED)
    if healthy.coast_time_constant_s is None:
        return ranked(_sums(FELL_AT_ONCE, COASTED))
    fall = _Fall.of(window, int(turning[-1]), healthy, balance, tacho)
    at_once, coasting = (fall.likelihood(constants_s) + LEAST_LIKELIHOOD for constants_s in fall.constants_s)
    likely = {cause: prior * at_once for cause, prior in FELL_AT_ONCE.items()}
    return ranked(_sums(likely, COASTED * coasting))


@dataclass(frozen=True)
class ComingToRest:
    """How probable it is that a fan comes to rest, and why it would; the causes' probabilities add up to one."""

    probability: float
    causes: tuple[RankedCause, ...]

    def beside(self, of_turning: tuple[RankedCause, ...]) -> tuple[RankedCause, ...]:
        """These causes and those that `diagnose` found, which are of a fan that does not come to rest."""
        unclear = next(each for each in of_turning if each.cause == CANNOT_TELL)
        named = [each for each in of_turning if each is not unclear]
        share = (1.0 - self.probability) / (max(each.probability for each in named) + unclear.probability)
        causes = [replace(each, probability=each.probability * share) for each in named]
        causes += [replace(each, probability=each.probability * self.probability) for each in self.causes]
        highest = max(each.probability for each in causes)
        sentence = unclear.sentence if self.probability < 0.5 else UNCLEAR
        causes.append(replace(unclear, probability=1.0 - highest, sentence=sentence))
        total = sum(each.probability for each in causes)
        causes = [replace(each, probability=each.probability / total) for each in causes]
        return tuple(sorted(causes, key=lambda cause: -cause.probability))


def coming_to_rest(window: Window, healthy: Standstill, balance: HealthyBalance, tacho: Tacho) -> ComingToRest | None:
    """Of a fan that is driven and whose reading has fallen; None where it has not, or nothing is known of coasts."""
    window = window.as_given
    command, speed = float(window.command[-1]), np.abs(window.speed_rad_s)
    turning = np.flatnonzero(healthy.turns(speed))
    if healthy.coast_time_constant_s is None or not command >= healthy.turning_command or not np.isfinite(speed[-1]):
        return None
    if not len(turning) or not _was_driven(window, int(turning[-1]), healthy, tacho):
        return None
    fall = _Fall.of(window, int(turning[-1]), healthy, balance, tacho, SAME_ERROR_S)
    left = float(fall.readings[-1])  # not finite where the fan stood before
    if not left < FALLING_SHARE or speed[-1] >= FALLING_SHARE * fall.highest_rad_s:
        return None
    at_once, coasting = (fall.likelihood(constants_s) for constants_s in fall.constants_s)
    lowest = healthy.standing_below_rad_s / fall.highest_rad_s
    slowing = fall.likelihood_of_slowing(np.concatenate(fall.constants_s), lowest) + LEAST_LIKELIHOOD
    weights = _sums({cause: prior * at_once for cause, prior in FELL_AT_ONCE.items()}, COASTED * coasting)
    weights = weighed_by_supply(weights, window)
    stops = COMES_TO_REST * sum(weights.values())
    if not stops > 0.0:
        return None
    slower = f"slows down to {100 * left:.0f} % of its speed although commanded to {command:.3g}"
    sentence = f"{slower}{supply_in_words(window)}"
    evidence = Evidence(FALLING, left - 1.0, left - 1.0, left - 1.0, "relative")
    return ComingToRest(stops / (stops + (1.0 - COMES_TO_REST) * slowing), _ranked(weights, evidence, sentence))


@dataclass(frozen=True, eq=False)
class _Fall:
    """The readings of a fan around the time when it began to fall, as shares of the speed before."""

    at_s: Array
    readings: Array
    falls_s: Array
    """times at which the fall may have begun"""
    phases_s: Array
    """times at which the windows of the tacho may have begun"""
    error: float
    """standard deviation of a reading"""
    weight: float
    """of a sample: a reading counts once"""
    highest_rad_s: float
    constants_s: tuple[Array, Array]
    """possible time constants of a fan that stops at once, and of one that coasts"""
    tacho: Tacho

    @staticmethod
    def of(
        window: Window,
        last_turning: int,
        healthy: Standstill,
        balance: HealthyBalance,
        tacho: Tacho,
        same_error_s: float = 0.0,
    ) -> _Fall:
        """same_error_s: readings within this time count as one, and few of them are used."""
        share, level = _shares(window, last_turning, healthy, balance, tacho)
        time_s: Array = window.period_s * np.arange(len(share), dtype=np.float64)
        constant_s = healthy.coast_time_constant_s or 0.0
        turned = np.abs(window.speed_rad_s[: last_turning + 1])
        before_rad_s = max(float(np.nanmax(turned)), healthy.standing_below_rad_s)
        longest_s = LONGEST_COASTS * constant_s * math.log(before_rad_s / healthy.standing_below_rad_s) + tacho.reach_s
        rows = np.flatnonzero((time_s >= time_s[last_turning] - longest_s) & np.isfinite(share))
        every = max(1, round(same_error_s / SAMPLES_OF_AN_ERROR / window.period_s))
        rows = rows[(len(rows) - 1) % every :: every]
        at_s: Array = time_s[rows]
        with np.errstate(divide="ignore", invalid="ignore"):  # a fan that stood before has a level of 0
            readings: Array = share[rows] / level
            resolution = tacho.resolution_rad_s * readings[0] / max(float(np.abs(window.speed_rad_s[rows[0]])), 1e-9)
        at_rest_s = at_s[at_s > time_s[last_turning]]
        reading_s = max(tacho.held_s, same_error_s)
        return _Fall(
            at_s=at_s,
            readings=readings,
            falls_s=np.linspace(at_s[0], at_rest_s[0] if len(at_rest_s) else time_s[-1], FALLS),
            phases_s=np.linspace(0.0, tacho.held_s, PHASES, endpoint=False) if tacho.held_s else np.zeros(1),
            error=math.hypot(resolution / math.sqrt(6.0), READING_ERROR),
            weight=min(every * window.period_s / reading_s, 1.0) if reading_s else 1.0,
            highest_rad_s=float(np.abs(window.speed_rad_s[rows]).max()),
            constants_s=(np.array([AT_ONCE_S]), constant_s * COAST_FACTORS),
            tacho=tacho,
        )

    def likelihood(self, constants_s: Array) -> float:
        """That the fan comes to rest with one of these time constants."""
        squares = np.square((self.readings - self._expected(constants_s)) / self.error).sum(axis=-1)
        return float(np.exp(-0.5 * self.weight * squares).mean())

    def likelihood_of_slowing(self, constants_s: Array, lowest: float) -> float:
        """That it slows down to a share of its speed, from the lowest to 1. The share that it loses has a normal prior,
        as the sizes of the faults of a fan that turns (scoring.diagnosis.hypotheses), so that the integral has a closed
        form.
        """
        expected = self._expected(constants_s)
        rest, by_share = (self.readings - expected) / self.error, (1.0 - expected) / self.error
        information = self.weight * np.square(by_share).sum(axis=-1) + LOSS_STD**-2
        share = (self.weight * (rest * by_share).sum(axis=-1) + LOSS_STD**-2) / information
        squares = self.weight * np.square(rest).sum(axis=-1) + LOSS_STD**-2 - information * np.square(share)
        width = 1.0 / np.sqrt(information)
        mass = width * _mass(lowest, share, width) / (LOSS_STD * _mass(lowest, 1.0, LOSS_STD))
        return float((np.exp(-0.5 * squares) * mass).mean())

    def _expected(self, constants_s: Array) -> Array:
        """(falls, phases, constants, n) readings of a fan that comes to rest."""
        fall_s, phase_s, constant_s = (
            each[..., np.newaxis] for each in np.meshgrid(self.falls_s, self.phases_s, constants_s, indexing="ij")
        )
        return _readings_of_a_fall(self.at_s, fall_s, constant_s, self.tacho, phase_s)


def _readings_of_a_fall(at_s: Array, fall_s: Array, constant_s: Array, tacho: Tacho, phase_s: Array) -> Array:
    """(..., n) readings of a fan that turned at a speed of 1 and comes to rest with a time constant; broadcast."""

    def turned(until_s: Array) -> Array:
        after_s = np.maximum(until_s - fall_s, 0.0)
        return np.minimum(until_s, fall_s) + constant_s * -np.expm1(-after_s / constant_s)

    shown_s = at_s - tacho.delay_s
    if not tacho.window_s:
        return np.exp(-np.maximum(shown_s - fall_s, 0.0) / constant_s)
    end_s = phase_s + np.floor((shown_s - phase_s) / tacho.held_s) * tacho.held_s
    return (turned(end_s) - turned(end_s - tacho.window_s)) / tacho.window_s


def _was_driven(window: Window, last_turning: int, healthy: Standstill, tacho: Tacho) -> bool:
    """Whether the command turned the fan when it turned last, a reading's reach before included."""
    first = max(last_turning - math.ceil(tacho.reach_s / window.period_s), 0)
    command = window.command[first : last_turning + 1]
    known = command[np.isfinite(command)]
    return bool(len(known)) and bool(np.all(healthy.drives(known)))


def _shares(
    window: Window, last_turning: int, healthy: Standstill, balance: HealthyBalance, tacho: Tacho
) -> tuple[Array, float]:
    """(n,) readings as shares of the steady speed for their command, so that a moving command is not taken for the
    fall; and the share of the fan before its reading fell.
    """
    speed = np.abs(window.speed_rad_s)
    turned = speed[: last_turning + 1]
    share = speed / np.maximum(_steady_speed(window.command, balance, turned), healthy.standing_below_rad_s)
    constant_s = healthy.coast_time_constant_s or 0.0
    longest_s = constant_s * math.log(np.nanmax(turned) / healthy.standing_below_rad_s) + tacho.reach_s
    before = max(len(turned) - math.ceil(longest_s / window.period_s), 0)
    reference = share[max(before - round(LEVEL_S / window.period_s), 0) : before]
    reference = reference[np.isfinite(reference)]
    return share, float(np.median(reference)) if len(reference) else 1.0


def _steady_speed(command: Array, balance: HealthyBalance, speed_rad_s: Array) -> Array:
    """The speeds at which a healthy fan settles under commands, rad/s."""
    speeds = np.linspace(0.0, 2.0 * float(np.nanmax(speed_rad_s)), GRID)
    needed = balance.friction + balance.viscous * speeds + balance.drag * speeds**2
    return np.interp(command, np.maximum.accumulate(needed), speeds)


def _mass(lowest: float, mean: Array | float, width: Array | float) -> Array:
    """Probability that a normally distributed share is from the lowest to 1."""
    return ndtr((1.0 - mean) / width) - ndtr((lowest - mean) / width)


def _sums(causes: Mapping[str, float], no_power: float) -> dict[str, float]:
    return {**causes, NO_POWER: causes[NO_POWER] + no_power}


def _of_command(command: float) -> Evidence | None:
    return Evidence("command", command, command, command, "command") if math.isfinite(command) else None


def _ranked(weights: Mapping[str, float], evidence: Evidence | None, sentence: str) -> tuple[RankedCause, ...]:
    total = sum(weights.values())
    causes = [RankedCause(cause, weight / total, evidence, sentence) for cause, weight in weights.items()]
    return tuple(sorted(causes, key=lambda cause: -cause.probability))
