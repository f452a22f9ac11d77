"""The decision on the fans of one tray: alarms, their causes, and when they are over."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from bench.detection.one_model.bins import Bin
from bench.detection.one_model.faults import FAULTS, forces
from bench.detection.one_model.healthy import FAULT, SLOW, SLOWEST_RAD_S, HealthyFans, Innovation, Priors
from bench.detection.one_model.in_alarm import FanInAlarm
from bench.detection.one_model.missing import MissingReadings
from bench.detection.one_model.onsets import Evidence, Hypotheses
from bench.detection.one_model.operation import Fans, Inputs, Operation
from schemas.messages import Array
from schemas.units import NS_PER_S

ALONE_SIGMAS, AGREED_SIGMAS = 4.5, 8.0
"""a reading that is farther from what is expected counts if the next agrees, and then no farther than the latter"""
OF_RATE = 0.8
"""share of the declared rate that the speed has; missing readings have the rest"""
NAMED_FROM = 0.7
"""probability of a cause"""
NAMED_AFTER_S, FALLING, FALLING_S = 3.0, 0.4, 4.0
"""an onset is so old before a cause is named; a fan that has lost such a share of its speed may come to rest"""
STANDS, FALLS = 0.08, 0.85
"""shares of the expected speed"""
OF_COAST = 0.7
"""least share of a coast that is seen between these; a held rotor shows at most the reading in which it stops"""
WALKS_PER_SQRT_S = 0.1
"""how fast the fault of an alarm may change, of its largest size"""
OVER_S, OVER_ODDS = 10.0, 100.0
"""time for which a healthy fan is likelier, by these odds, than the fault at its largest, until that is over"""
STANDSTILL = ("blocked", "no_power")
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
        self._hypotheses = Hypotheses(FAULTS, fans.has_own_drive)
        self._evidence = Evidence(count, self._hypotheses, self._bin_s)
        bins = declared_s / self._bin_s
        self.log_limit = math.log(bins / OF_RATE)
        self._missing = MissingReadings(count, math.log(bins / (1.0 - OF_RATE)))
        self.log_statistic = np.full(count, -np.inf)
        self._waits = np.zeros(count)
        """(fans,) the sign of a far reading that the next must agree with"""
        self._alarms: dict[int, FanInAlarm] = {}
        self._active = np.zeros(count, np.bool_)
        self._raised = np.zeros(count, np.int64)
        """(fans,) bin of the alarm"""
        self._peak, self._over_s = np.zeros(count), np.zeros(count)
        """(fans,) share of the speed that the fault took at most, with its sign; and how long it has been over"""
        self._cause = [""] * count
        self._falls_s, self._stands = np.zeros(count), np.zeros(count, np.bool_)

    def take(self, one: Bin) -> Iterator[Change]:
        """What changes with a bin."""
        was_missing = self._missing.is_active.copy()
        self._missing.take(one.missing)
        was_active = self._active.copy()
        now = self._operation.inputs(one)
        pushes = self._weigh(now)
        known = now.readings > 0
        self._follow_fall(now, known)
        for fan in np.flatnonzero(known & ~self._active & (self.log_statistic > self.log_limit)).tolist():
            self._raise(fan, pushes[fan], float(now.speed_rad_s[fan]))
        for fan in np.flatnonzero(was_active & self._is_over(known)).tolist():
            self._end(fan)
        before, after = was_active | was_missing, self._active | self._missing.is_active
        for fan in np.flatnonzero(before != after).tolist():
            yield Change(fan, bool(after[fan]), "sensor_dropout" if self._missing.is_active[fan] else "")
        for fan in np.flatnonzero(known & self._active).tolist():
            cause = self._likeliest(fan, now)
            if cause and cause != self._cause[fan]:
                self._cause[fan] = cause
                yield Change(fan, True, cause)

    def _weigh(self, now: Inputs) -> Array:
        """Let model and evidence take the readings up; returns what the columns of the faults do."""
        model, evidence = self._model, self._evidence
        evidence.begin(now.moved_to_rad_s - now.moves_rad_s2 * self._bin_s)
        model.predict(now)
        found = model.innovation(now)
        counts = self._counts(now, found)
        root = np.sqrt(found.variance)
        gain = found.with_states * (counts / found.variance)[:, np.newaxis]
        gain[self._active, SLOW] = 0.0
        agreed = found.distance_rad_s.clip(-AGREED_SIGMAS * root, AGREED_SIGMAS * root)
        pushes = forces(self._fans, now, evidence.age_s, evidence.then_rad_s)
        evidence.add(pushes, model, found, gain, agreed)
        farthest = np.where(self._active, AGREED_SIGMAS, ALONE_SIGMAS) * root
        model.update(found, gain, agreed.clip(-farthest, farthest))
        for fan, alarm in self._alarms.items():
            alarm.take(now.of(fan), self._bin_s, counts=bool(counts[fan]))
        self.log_statistic = np.where(now.readings > 0, evidence.log_statistic(), self.log_statistic)
        return pushes

    def _counts(self, now: Inputs, found: Innovation) -> Array:
        """(fans,) whether a reading counts: one that is far only if the one before it was far on the same side."""
        known, sign = now.readings > 0, np.sign(found.distance_rad_s)
        is_far = known & (np.square(found.distance_rad_s) > ALONE_SIGMAS**2 * found.variance)
        counts: Array = known & (~is_far | (self._waits * sign > 0.0))
        self._waits = np.where(known, np.where(is_far, sign, 0.0), self._waits)
        return counts

    def _raise(self, fan: int, pushes: Array, speed_rad_s: float) -> None:
        """Begin an alarm: what the filter has taken of the likeliest fault is given back, and the fault becomes a
        state. pushes: (onsets, COLUMNS) of `forces`."""
        evidence, model = self._evidence, self._model
        self._alarms[fan] = FanInAlarm(fan, self._fans, model, evidence, self._hypotheses)
        terms = evidence.log_terms[fan]
        onset, fault = (int(index) for index in np.unravel_index(int(np.argmax(terms)), terms.shape))
        columns = np.array(FAULTS[fault].columns)
        sizes, of_sizes = self._hypotheses.sizes(evidence.sums, fan, onset, fault)
        makes = evidence.sums.taken[fan, onset, columns]  # of the states less what the filter has taken for its own
        makes[:, FAULT] = pushes[onset, columns] / max(speed_rad_s, SLOWEST_RAD_S)
        model.mean[fan] += sizes @ makes
        model.covariance[fan] += makes.T @ of_sizes @ makes
        size = float(model.mean[fan, FAULT])
        self._peak[fan] = math.copysign(max(abs(size), SMALLEST), size)
        self._active[fan], self._over_s[fan], self._cause[fan] = True, 0.0, ""
        self._raised[fan] = evidence.number
        self._forget(fan)

    def _end(self, fan: int) -> None:
        del self._alarms[fan]
        model = self._model
        model.mean[fan, FAULT] = model.noise[fan, FAULT] = 0.0
        model.covariance[fan, FAULT], model.covariance[fan, :, FAULT] = 0.0, 0.0
        self._active[fan] = False
        self._forget(fan)

    def _forget(self, fan: int) -> None:
        self._evidence.forget(fan)
        self.log_statistic[fan] = -np.inf

    def _is_over(self, known: Array) -> Array:
        """(fans,) whether for some time a healthy fan has been likelier than the fault at its largest."""
        model, peak = self._model, self._peak
        size, variance = model.mean[:, FAULT], model.covariance[:, FAULT, FAULT]
        surely = np.sign(size) * (np.abs(size) - 2.0 * np.sqrt(variance))
        is_larger = known & self._active & (surely * np.sign(size) > np.abs(peak))
        self._peak = np.where(is_larger, surely, peak)
        model.noise[:, FAULT] = np.where(self._active, np.square(WALKS_PER_SQRT_S * self._peak) * self._bin_s, 0.0)
        is_healthy = self._peak * (0.5 * self._peak - size) > variance * math.log(OVER_ODDS)
        over_s = np.where(is_healthy & self._active, self._over_s + self._bin_s, 0.0)
        self._over_s = np.where(known, over_s, self._over_s)
        found: Array = self._over_s >= OVER_S
        return found

    def _follow_fall(self, now: Inputs, known: Array) -> None:
        expected = now.speed_rad_s - np.where(now.is_balance, now.deviation_rad_s, 0.0)
        share = np.abs(now.newest_rad_s) / np.maximum(expected, 1.0)
        passed_s = self._operation.bins_held * self._bin_s
        falls_s = np.where(share > FALLS, 0.0, self._falls_s + share * passed_s)
        self._falls_s = np.where(known, falls_s, self._falls_s)
        self._stands = np.where(known, share < STANDS, self._stands)

    def _likeliest(self, fan: int, now: Inputs) -> str:
        """The cause, or nothing while it cannot be told."""
        if self._cause[fan] in STANDSTILL:
            return ""
        if self._stands[fan]:
            stops_s = 0.5 * (FALLS * self._fans.held_s[fan] + OF_COAST * self._fans.coasts_s[fan])
            return "blocked" if self._falls_s[fan] < stops_s else "no_power"
        is_falling = now.deviation_rad_s[fan] < -FALLING * now.speed_rad_s[fan]
        is_new = (self._evidence.number - self._raised[fan]) * self._bin_s < FALLING_S
        alarm = self._alarms[fan]
        if alarm.age_s < NAMED_AFTER_S or (is_falling and is_new):
            return ""
        top = max(alarm.causes, key=lambda cause: alarm.causes[cause])
        return top if alarm.causes[top] >= NAMED_FROM else ""
