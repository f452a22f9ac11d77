"""Fans made up bin by bin: healthy ones drawn from the priors of the model, and faults planted by their own columns.

They are written from the equations of scoring.model.healthy, and share no code with its filter but hat functions.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from fantwin.schemas.messages import Array
from fantwin.schemas.units import NS_PER_S
from fantwin.scoring.model.bins import Bin
from fantwin.scoring.model.decision import Decision
from fantwin.scoring.model.faults import COLUMNS, OF_TACHO, STUCK, forces
from fantwin.scoring.model.healthy import AGE, AIR, FALL, FAULT, LATE, LOCAL, RISE, SAG, WANDER, HealthyFans, K, hats
from fantwin.scoring.model.operation import Fans, Operation
from fantwin.scoring.model.population import Priors
from tests.support.scored_blocks import EPOCH_NS

PRIORS = Priors()
Course = Callable[[float], Array | float]
"""course of a speed over the time, s"""
Changes = list[tuple[float, int, bool]]


def bin_of(number: int, bin_ns: int, fans: int, speed_rad_s: Array | float, **more: Array | float) -> Bin:
    """A bin in which the twin predicts a speed and nothing is measured, but for what is given; (fans,) each."""
    nothing = np.zeros(fans)
    made = Bin(
        t_ns=(EPOCH_NS // bin_ns + number + 1) * bin_ns,
        row=0,
        judged=np.ones(fans, np.bool_),
        deviations_rad_s=np.full((1, fans), np.nan),
        balances_command=np.full((1, fans), np.nan),
        wrong=np.zeros((1, fans), np.bool_),
        half_ranges_rad_s=np.zeros((1, fans)),
        readings=nothing,
        deviation_rad_s=nothing,
        predicted_rad_s=nothing + speed_rad_s,
        measured_rad_s=np.full(fans, np.nan),
        newest_rad_s=np.full(fans, np.nan),
        another=np.zeros((1, fans), np.bool_),
        balances=nothing,
        balance_command=nothing,
        half_range_rad_s=nothing,
        unseen_rad_s=nothing,
        unseen_balance_command=nothing,
        command=nothing + speed_rad_s,
        missing=np.zeros((fans, 4)),
    )
    return replace(made, **{name: nothing + value for name, value in more.items()})


def with_reading(one: Bin, deviation_rad_s: Array) -> Bin:
    """The bin with one reading of each fan."""
    measured = one.predicted_rad_s + deviation_rad_s
    return replace(
        one,
        readings=np.ones(len(measured)),
        deviation_rad_s=deviation_rad_s,
        deviations_rad_s=deviation_rad_s[np.newaxis],
        measured_rad_s=measured,
        newest_rad_s=measured,
        another=np.ones((1, len(measured)), np.bool_),
    )


def with_balance(one: Bin, balance_command: Array) -> Bin:
    """The bin with one torque balance of each fan, in the place of its readings."""
    nothing = np.zeros(len(balance_command))
    return replace(
        one,
        readings=nothing,
        deviations_rad_s=np.full((1, len(nothing)), np.nan),
        balances=nothing + 1.0,
        balance_command=balance_command,
        balances_command=balance_command[np.newaxis],
    )


class MadeFans:
    """Fans that do what the model of a healthy fan says, each with an error of its twin of its own, and their faults.

    `own` scales what differs from fan to fan: 1 as the priors say, 0 for fans that are like their twin.
    """

    def __init__(self, fans: Fans, bin_s: float, speed: Course, *, seed: int, own: float = 1.0) -> None:
        """Begin without a fault. speed: as the twin predicts it."""
        self.fans, self.count = fans, len(fans.top_rad_s)
        self.bin_s, self.bin_ns = bin_s, round(bin_s * NS_PER_S)
        self._speed, self._own = speed, own
        self._rng = np.random.default_rng(seed)
        self._operation = Operation(fans, self.bin_ns)
        prior = HealthyFans(fans, PRIORS, bin_s, bin_s).covariance[:, :FAULT, :FAULT]
        root = np.linalg.cholesky(prior + 1e-15 * np.eye(FAULT))
        self.states = own * (root @ self._drawn(FAULT, 1))[:, :, 0]
        """(fans, FAULT) states of the model"""
        self.rotor_rad_s: Array | None = None
        self._missed, self._newest_rad_s = np.zeros((2, self.count))
        self.number = 0
        self.sizes = np.zeros((self.count, COLUMNS))
        """sizes of the faults of now"""
        self.fault_from_s = np.inf

    @property
    def time_s(self) -> float:
        """End of the last bin."""
        return round(self.number * self.bin_s, 9)

    def decision(self, declared_s: float = 100.0 * 86400.0) -> Decision:
        """What decides on such fans."""
        return Decision(self.fans, self.bin_ns, self.bin_s, declared_s, PRIORS)

    def next(self) -> Bin:
        """The next bin, with a reading of each fan."""
        time_s = (self.number + 1) * self.bin_s
        one = bin_of(self.number, self.bin_ns, self.count, self._speed(time_s))
        self.number += 1
        now = self._operation.inputs(one)
        self._move(np.abs(now.moves_rad_s2) * self.bin_s / self.fans.top_rad_s + now.command_moved, now.speed_rad_s)
        states, speed, top = self.states, now.speed_rad_s, self.fans.top_rad_s
        tends = speed * (np.sum(hats(speed / top) * states[:, :K], axis=1) + states[:, SAG] * now.load)
        tends += speed * (states[:, AGE] + states[:, AIR] + states[:, LOCAL] + states[:, WANDER])
        tends -= states[:, RISE] * now.moves_rad_s2.clip(0.0) + states[:, FALL] * now.moves_rad_s2.clip(None, 0.0)
        age_s = max(time_s - self.fault_from_s, 0.0)
        then_rad_s = np.full((self.count, 1), self._speed(min(self.fault_from_s, time_s)))
        pushes = forces(self.fans, now, np.array([age_s]), then_rad_s)
        pushes = self.sizes * pushes[:, 0] * (age_s > 0.0)
        shown = pushes[:, OF_TACHO].sum(axis=1)
        tends += pushes.sum(axis=1) - shown
        before = tends if self.rotor_rad_s is None else self.rotor_rad_s
        decay = (self.fans.viscous + self.fans.drag * (2.0 * speed + before)) / self.fans.inertia * self.bin_s
        follows = -np.expm1(-decay)
        self.rotor_rad_s = before + (tends - before) * follows
        mean = before + (tends - before) * (1.0 - follows / decay)
        missed = self._missed
        self._missed = PRIORS.count * self.fans.pulse_rad_s / np.sqrt(12.0) * self._drawn()
        white = np.hypot(self.fans.noise_rad_s, self.fans.timing_s * now.rate_rad_s2) * self._drawn()
        deviation = mean + shown - states[:, LATE] * now.moves_rad_s2 + self._missed - missed + white
        is_stuck = (self.sizes[:, STUCK] > 0.0) & (age_s > 0.0)
        deviation = np.where(is_stuck, then_rad_s[:, 0] - one.predicted_rad_s, deviation)
        one = with_reading(one, deviation)
        before, self._newest_rad_s = self._newest_rad_s, one.newest_rad_s
        return replace(one, another=(one.newest_rad_s != before)[np.newaxis])

    def _move(self, moved: Array, speed: Array) -> None:
        """Let the states go on by one bin."""
        states, p, own = self.states, PRIORS, self._own
        states[:, AGE] += own * p.ageing_per_sqrt_h * np.sqrt(self.bin_s / 3600.0) * self._drawn()
        for state, std, time_s in ((WANDER, p.wander, p.wander_s), (AIR, own * p.air, p.air_s)):
            kept = np.exp(-self.bin_s / time_s)
            states[:, state] = kept * states[:, state] + std * np.sqrt(1.0 - kept**2) * self._drawn()
        kept = np.exp(-moved / p.local_length - self.bin_s / p.local_s)
        new = own * p.local_rad_s / np.maximum(speed, 10.0) * np.sqrt(1.0 - kept**2)
        states[:, LOCAL] = kept * states[:, LOCAL] + new * self._drawn()

    def _drawn(self, *shape: int) -> Array:
        return self._rng.normal(size=(self.count, *shape))


def plays(
    made: MadeFans, decision: Decision, seconds: float, change: Callable[[Bin], Bin] = lambda one: one
) -> Changes:
    """What a decision says of the next bins: time, s, fan, and whether its alarm was raised, else cleared."""
    found: Changes = []
    for _ in range(round(seconds / made.bin_s)):
        changes = decision.take(change(made.next()))
        found += [(made.time_s, each.fan, each.raised) for each in changes]
    return found
