"""The decision on the fans of one tray: alarms, their causes, and when they are over."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from bench.detection.one_model.bins import Bin
from bench.detection.one_model.faults import COLUMNS, DRAG, FAULTS, effect, forces
from bench.detection.one_model.healthy import AIR, LOCAL, SAG, SLOW, STATES, HealthyFans, Innovation, K, Priors, hats
from bench.detection.one_model.missing import MissingReadings
from bench.detection.one_model.onsets import LONGEST_S, Evidence
from bench.detection.one_model.operation import Fans, Inputs, Operation
from schemas.messages import Array
from schemas.units import NS_PER_S

ALONE_SIGMAS, AGREED_SIGMAS = 4.5, 8.0
"""a reading that is farther from what is expected counts if the next agrees, and then no farther than the latter"""
OF_RATE = 0.8
"""share of the declared rate that the speed has; missing readings have the rest"""
NAMED_FROM = 0.6
"""probability of a cause"""
NAMED_AFTER_S, FALLING, FALLING_S = 3.0, 0.4, 4.0
"""an onset is so old before a cause is named; a fan that has lost such a share of its speed may come to rest"""
STANDS, FALLS, COASTS_S = 0.08, 0.85, 0.85
"""shares of the expected speed, and how long a fan without power turns: the integral of that share while it falls"""
OVER_S = (10.0, 30.0)
"""a fault is over if it is not seen over any of the times between"""
OVER_SHARE, OVER_SIGMAS = 0.5, 2.33
"""it is over if it is below half of what it was, with a probability of 99 %"""
SMALLEST = 0.01
"""share of the speed: what a fault takes at least"""


@dataclass(frozen=True)
class Change:
    """An alarm of a fan was raised or cleared, or its cause was named."""

    fan: int
    raised: bool
    cause: str = ""


class Decision:
    """Alarms of the fans of one tray."""

    def __init__(self, fans: Fans, bin_ns: int, period_s: float, declared_s: float, priors: Priors) -> None:
        """Begin without an alarm. period_s: of the samples; declared_s: mean time between two false alarms of a fan."""
        count = len(fans.top_rad_s)
        self._fans, self._bin_s = fans, bin_ns / NS_PER_S
        self._operation = Operation(fans, bin_ns)
        self._model = HealthyFans(fans, priors, self._bin_s, period_s)
        self._evidence = Evidence(count, FAULTS, self._bin_s)
        bins = declared_s / self._bin_s
        self.log_limit = math.log(bins / OF_RATE)
        self._missing = MissingReadings(count, math.log(bins / (1.0 - OF_RATE)))
        self.log_statistic = np.full(count, -np.inf)
        self._waits = np.zeros(count)
        """(fans,) the sign of a far reading that the next must agree with"""
        self._active = np.zeros(count, np.bool_)
        self._raised, self._onset = np.zeros(count, np.int64), np.zeros(count, np.int64)
        """(fans,) bins of the alarm, and of what it found the likeliest onset"""
        self._peak = np.zeros(count)
        """(fans,) share of the speed that the fault took at most"""
        self._cause = [""] * count
        self._falls_s, self._stands = np.zeros(count), np.zeros(count, np.bool_)

    def take(self, one: Bin) -> Iterator[Change]:
        """What changes with a bin."""
        was_missing = self._missing.is_active.copy()
        self._missing.take(one.missing)
        was_active = self._active.copy()
        now = self._operation.inputs(one)
        self._weigh(now)
        known = now.readings > 0
        self._follow_fall(now, known)
        for fan in np.flatnonzero(known & ~self._active & (self.log_statistic > self.log_limit)).tolist():
            self._raise(fan)
        for fan in np.flatnonzero(known & self._active & was_active & self._is_over(now)).tolist():
            self._end(fan)
        before, after = was_active | was_missing, self._active | self._missing.is_active
        for fan in np.flatnonzero(before != after).tolist():
            yield Change(fan, bool(after[fan]), "sensor_dropout" if self._missing.is_active[fan] else "")
        for fan in np.flatnonzero(known & self._active).tolist():
            cause = self._likeliest(fan, now)
            if cause and cause != self._cause[fan]:
                self._cause[fan] = cause
                yield Change(fan, True, cause)

    def _weigh(self, now: Inputs) -> None:
        """Let model and evidence take the readings up."""
        model, evidence = self._model, self._evidence
        evidence.begin()
        model.predict(now)
        found = model.innovation(now)
        gain, distance = self._counted(now, found)
        root = np.sqrt(found.variance)
        agreed = np.where(self._active, distance, distance.clip(-AGREED_SIGMAS * root, AGREED_SIGMAS * root))
        evidence.add(forces(self._fans, now, evidence.age_s), model, found, gain, agreed)
        learned = np.where(self._active, distance, distance.clip(-ALONE_SIGMAS * root, ALONE_SIGMAS * root))
        model.update(found, gain, learned)
        self.log_statistic = np.where(now.readings > 0, evidence.log_statistic(), self.log_statistic)

    def _counted(self, now: Inputs, found: Innovation) -> tuple[Array, Array]:
        """The gain, 0 where a reading does not count, and for states that an alarm holds; and the distance."""
        distance, known = found.distance_rad_s, now.readings > 0
        sign = np.sign(distance)
        is_far = known & (np.square(distance) > ALONE_SIGMAS**2 * found.variance)
        counts = known & (~is_far | (self._waits * sign > 0.0) | self._active)
        self._waits = np.where(known, np.where(is_far, sign, 0.0), self._waits)
        gain = found.with_states * (counts / found.variance)[:, np.newaxis]
        gain[self._active, SLOW] = 0.0
        return gain, distance

    def _raise(self, fan: int) -> None:
        evidence, model = self._evidence, self._model
        terms = evidence.log_terms[fan]
        onset, fault = (int(index) for index in np.unravel_index(int(np.argmax(terms)), terms.shape))
        columns = np.array(FAULTS[fault].columns)
        of_columns, covariance = evidence.sizes(fan, onset, fault)
        taken = evidence.taken[fan, onset, columns, SLOW]  # less than nothing: what the filter has taken for its own
        model.mean[fan, SLOW] += of_columns @ taken
        model.covariance[fan, SLOW, SLOW] += taken.T @ covariance @ taken
        evidence.taken[fan, :, :, SLOW] = 0.0
        sizes = np.zeros(COLUMNS)
        sizes[columns] = of_columns
        self._peak[fan] = max(abs(effect(sizes, float(evidence.age_s[onset]))), SMALLEST)
        self._active[fan] = True
        self._raised[fan], self._onset[fan], self._cause[fan] = evidence.number, evidence.began[onset], ""

    def _end(self, fan: int) -> None:
        self._active[fan] = False
        self._evidence.forget(fan)
        self.log_statistic[fan] = -np.inf

    def _is_over(self, now: Inputs) -> Array:
        """(fans,) whether a fault is below half of what it was, over all recent times."""
        evidence, model = self._evidence, self._model
        age_s = evidence.age_s
        recent = (age_s >= OVER_S[0]) & (age_s <= OVER_S[1]) & (evidence.began > self._raised[:, np.newaxis])
        squares = evidence.squares[:, :, DRAG, DRAG]
        recent &= squares > 0.0
        row = np.zeros((len(self._peak), STATES))
        row[:, :K] = hats(now.speed_rad_s / self._fans.top_rad_s)
        row[:, LOCAL] = row[:, AIR] = 1.0
        row[:, SAG] = now.load
        of_model = np.einsum("ni,nij,nj->n", row, model.covariance, row)
        with np.errstate(divide="ignore", invalid="ignore"):
            size = np.abs(evidence.products[:, :, DRAG] / squares)
            std = np.sqrt(1.0 / squares + of_model[:, np.newaxis])
            self._peak = np.maximum(self._peak, np.where(recent, size - 2.0 * std, 0.0).max(axis=1))
            is_small = size + OVER_SIGMAS * std < OVER_SHARE * self._peak[:, np.newaxis]
        found: Array = recent.any(axis=1) & (is_small | ~recent).all(axis=1)
        return found

    def _follow_fall(self, now: Inputs, known: Array) -> None:
        shown = now.speed_rad_s + np.where(now.is_balance, 0.0, now.deviation_rad_s)
        share = shown / np.maximum(shown - now.deviation_rad_s, 1.0)
        passed_s = self._operation.bins_held * self._bin_s
        falls_s = np.where(share > FALLS, 0.0, self._falls_s + share.clip(0.0) * passed_s)
        self._falls_s = np.where(known, falls_s, self._falls_s)
        self._stands = np.where(known, share < STANDS, self._stands)

    def causes(self, fan: int) -> dict[str, float]:
        """Posterior of the causes of an alarm, apart from those of a fan that stands."""
        terms = self._evidence.log_terms[fan]
        weights = np.exp(terms - terms.max()).sum(axis=0)
        found: dict[str, float] = {}
        for fault, weight in zip(FAULTS, weights / weights.sum(), strict=True):
            found[fault.cause] = found.get(fault.cause, 0.0) + float(weight)
        return found

    def _likeliest(self, fan: int, now: Inputs) -> str:
        """The cause, or nothing while it cannot be told."""
        if self._stands[fan]:
            return "blocked" if self._falls_s[fan] < COASTS_S else "no_power"
        number = self._evidence.number
        is_falling = now.deviation_rad_s[fan] < -FALLING * now.speed_rad_s[fan]
        is_new = (number - self._raised[fan]) * self._bin_s < FALLING_S
        age_s = (number - self._onset[fan] + 1) * self._bin_s
        if not NAMED_AFTER_S <= age_s <= LONGEST_S or (is_falling and is_new):
            return ""  # of an older onset too little is known any more
        causes = self.causes(fan)
        top = max(causes, key=lambda cause: causes[cause])
        return top if causes[top] >= NAMED_FROM else ""
