"""The decision on the fans of one tray at the end of each bin: which have an alarm, and how far they are from it."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from fantwin.schemas.messages import Array
from fantwin.schemas.units import NS_PER_S
from fantwin.scoring.model.bins import Bin
from fantwin.scoring.model.evidence_in_alarm import FansInAlarm
from fantwin.scoring.model.faults import BEFORE_GROWTH, FAULTS, forces
from fantwin.scoring.model.healthy import FAULT, SLOW, SLOWEST_RAD_S, HealthyFans
from fantwin.scoring.model.missing_readings import MissingReadings
from fantwin.scoring.model.onsets import Evidence, Hypotheses
from fantwin.scoring.model.operation import Fans, Inputs, Operation
from fantwin.scoring.model.population import Priors
from fantwin.scoring.model.wrong_readings import FAR_SIGMAS, WrongReadings
from fantwin.scoring.saved import Saved

AGREED_SIGMAS = 8.0
"""standard deviations to which the filter clips the distance of a reading of a fan in alarm"""
OF_RATE = 0.8
"""share of the declared rate for speed and torque balance; missing readings have the rest"""
WALKS_PER_SQRT_S = 0.1
"""random walk of the fault of an alarm: share of its largest size in one second"""
TOLD_APART = 16.0
"""least ratio of the square of that size to the variance of the walk: with more variance, coarse readings could not
tell a small fault from none, and its alarm would never clear"""
OVER_S, OVER_ODDS = 10.0, 100.0
"""time for which a healthy fan is likelier, by these odds, than the fault at its largest, until that is over"""
LEFT_SIGMAS = 3.0
"""largest remainder of a fault, in standard deviations, that may be an error of the healthy state instead: a fault of
that size is OVER_ODDS times as probable as none"""
PROBABLE = 0.05
"""least probability of a fault that an alarm may have"""
SMALLEST = 0.01
"""least share of the speed that a fault is taken to cost"""
FORGETS_S = 60.0
"""longest gap after which earlier evidence still counts"""
KEPT_FROM = 0.5
"""score from which a snapshot keeps the evidence of a fan"""
HIGHEST_SCORE = 99.0


@dataclass(frozen=True)
class Change:
    """An alarm of a fan was raised or cleared."""

    fan: int
    raised: bool


class Decision(Saved):
    """Alarms of the fans of one tray. What it tells of a fan is that of the end of the last bin."""

    LEARNED = (
        *("model", "missing", "active", "_peak", "_over_s", "is_returning", "in_balance", "deviation_rad_s"),
        *("deviation_std_rad_s", "_shape", "_is_probable", "_shows"),
    )
    """all that bins of another length go on with"""
    KEPT = (
        *LEARNED,
        *("log_statistic", "_raised", "onset", "_newest", "operation", "wrong", "_evidence", "alarms"),
    )

    def __init__(
        self, fans: Fans, bin_ns: int, period_s: float, declared_s: float, priors: Priors, limit_factor: float = 1.0
    ) -> None:
        """Begin without an alarm. period_s: of the samples; declared_s: mean time between two false alarms of a fan;
        limit_factor: of the log of the limit."""
        count = len(fans.top_rad_s)
        self._fans, self._bin_ns, self.bin_s = fans, bin_ns, bin_ns / NS_PER_S
        self.operation = Operation(fans, bin_ns)
        self.model = HealthyFans(fans, priors, self.bin_s, period_s)
        self._hypotheses = Hypotheses(FAULTS, fans.has_own_drive)
        self._evidence = Evidence(count, self._hypotheses, self.bin_s)
        bins = declared_s / self.bin_s
        self.log_limit = math.log(bins / OF_RATE) * limit_factor
        self.missing = MissingReadings(count, self.bin_s, math.log(bins / (1.0 - OF_RATE)) * limit_factor)
        self.log_statistic = np.full(count, -np.inf)
        self.wrong = WrongReadings(fans, self.bin_s, period_s, math.log(bins / OF_RATE))
        self.alarms = FansInAlarm(self.model, self._hypotheses)
        """evidence for the causes of the alarms"""
        self.active = np.zeros(count, np.bool_)
        """(fans,) true where the speed or the torque balance has an alarm"""
        self._raised, self.onset = np.zeros(count, np.int64), np.zeros(count, np.int64)
        """(fans,) bins in which an alarm was raised, and in which its fault probably began"""
        self._peak, self._over_s = np.zeros((2, count))
        """(fans,) share of the speed that the fault surely took, at most, with its sign; and for how long it is over"""
        faults = len(self._hypotheses.faults)
        self._shape, self._is_probable = np.ones((count, faults)), np.zeros((count, faults), np.bool_)
        """(fans, faults) share of the speed that each took where the fault of an alarm was at its largest; and true
        where it may be this fault"""
        self._shows = np.ones(count)
        """(fans,) least part of its largest share that a fault takes at the present speed"""
        self._newest = np.zeros(count, np.int64)
        """(fans,) bin of the newest reading"""
        self.is_returning = np.zeros(count, np.bool_)
        """(fans,) true where an alarm is active and a healthy fan is OVER_ODDS times as probable"""
        self.in_balance = np.zeros(count, np.bool_)
        """(fans,) true where the torque balance is read, and not the speed"""
        self.now: Inputs | None = None
        """what drove the model within the last bin; None: there was none"""
        self.deviation_rad_s, self.deviation_std_rad_s = np.zeros(count), np.zeros(count)
        """(fans,) newest reading less the one expected of this fan when it is healthy, and the standard deviation of
        this; where the torque balance is read, of the steady speed"""

    @property
    def number(self) -> int:
        """Number of the last bin."""
        return self._evidence.number

    @property
    def has_alarm(self) -> Array:
        """Return where a fan has an alarm of either kind, (fans,)."""
        return self.active | self.missing.is_active

    def take(self, one: Bin) -> list[Change]:
        """Process a bin; return the alarms that it raises or clears. Bins come in order of time."""
        passed = (one.t_ns - self.operation.t_ns) // self._bin_ns if self.operation.t_ns else 1
        if passed > 1:
            self._rest(passed - 1)
        before = self.has_alarm
        was_active = self.active.copy()
        self.missing.take(one.missing)
        now = self.operation.inputs(one)
        now = replace(now, is_new=now.is_new | (self.wrong.waits & (now.readings > 0)))  # what is far cannot wait
        for fan in np.flatnonzero((now.readings > 0) & (self.number - self._newest > FORGETS_S / self.bin_s)).tolist():
            self._forget(fan)  # the bins without a reading were no onsets
        now, pushes = self._weigh(one, now)
        self.now = now
        known = now.readings > 0
        self._newest = np.where(known, self.number, self._newest)
        self.in_balance = np.where(known, now.is_balance, self.in_balance)
        is_over_limit = np.isfinite(self.log_statistic) & (self.log_statistic > self.log_limit)
        for fan in np.flatnonzero(known & ~self.active & is_over_limit).tolist():
            self._raise(fan, pushes[fan], float(now.speed_rad_s[fan]))
        if self.active.any():
            for fan in np.flatnonzero(was_active & self._is_over(known, self._shares(now))).tolist():
                self._end(fan)
        off = now.deviation_rad_s - self.model.expected_rad_s
        self.deviation_rad_s = np.where(known, off, self.deviation_rad_s)
        after = self.has_alarm
        return [Change(fan, bool(after[fan])) for fan in np.flatnonzero(before != after).tolist()]

    @property
    def deviation_score(self) -> Array:
        """Score of speed and torque balance, (fans,): log R over log L; in an alarm the log odds of its fault over
        log L: at least 1, or 0 while a healthy fan is OVER_ODDS times as probable."""
        before = (self.log_statistic / self.log_limit).clip(0.0, 1.0)
        odds = self._log_odds() / self.log_limit
        during = np.where(self.is_returning, odds.clip(0.0, 1.0), odds.clip(1.0, HIGHEST_SCORE))
        return np.where(self.active, during, before)

    @property
    def score(self) -> Array:
        """Score, (fans,): the larger of `deviation_score` and the score of missing readings."""
        return np.maximum(self.deviation_score, self.missing.score)

    def raised_s(self, fan: int) -> float:
        """Time since the alarm of a fan was raised."""
        return float(self.number - self._raised[fan]) * self.bin_s

    def go_on_from(self, before: Decision) -> None:
        """Take over what another one has learned, whose bins are of another length; evidence begins again."""
        learned = before.arrays()
        for name in self.LEARNED:
            self.restore_one(name, learned)
        self._is_probable[:, self._hypotheses.stuck_rows] = False

    @property
    def fault(self) -> tuple[Array, Array]:
        """Effect of the fault of an alarm (- slower), (fans,), and its standard deviation: shares of the speed."""
        return self.model.mean[:, FAULT], np.sqrt(self.model.covariance[:, FAULT, FAULT])

    def begin_again(self, fans: Array) -> None:
        """Forget what was learned of some fans, (fans,) of bool, and end their alarms."""
        self.missing.forget(fans)
        self.wrong.begin_again(fans)
        for fan in np.flatnonzero(fans).tolist():
            if self.active[fan]:
                self._end(fan)
            self.model.begin_again(fan)
            self._forget(fan)

    def arrays(self) -> dict[str, Array]:
        """See Saved. Evidence that is small is not kept, nor that of an alarm, which is in `alarms`."""
        self._evidence.large = ~self.active & (self.log_statistic >= KEPT_FROM * self.log_limit)
        return super().arrays()

    def _rest(self, bins: int) -> None:
        """Let a gap pass."""
        self.model.rest(bins)
        self.wrong.forget()
        self._evidence.number += bins
        self.alarms.rest(bins, self.bin_s)
        if bins * self.bin_s > FORGETS_S:
            self._evidence.since[:] = self.number
            self.log_statistic[:] = -np.inf
            self.alarms.clear()
            self._is_probable[:, self._hypotheses.stuck_rows] = False

    def _weigh(self, one: Bin, now: Inputs) -> tuple[Inputs, Array]:
        """Update model and evidence with a bin; return the inputs that count, and `forces` of each onset."""
        model, evidence = self.model, self._evidence
        evidence.begin(now.moved_to_rad_s - now.moves_rad_s2 * self.bin_s)
        largest = self._peak * self._shows
        room = (np.square(largest) / TOLD_APART - self._own_variance()).clip(0.0)
        walk = np.square(WALKS_PER_SQRT_S * largest) * self.bin_s
        model.noise[:, FAULT] = np.where(self.active, np.minimum(walk, room), 0.0)
        evidence.show(now.changes)
        model.predict(now)
        now = self.operation.read(one, now, self._counts(one, now))
        found, counts = model.innovation(now), now.readings > 0
        root = np.sqrt(found.variance)
        gain = found.with_states * (counts / found.variance)[:, np.newaxis]
        gain[self.active, SLOW] = 0.0
        farthest = np.where(self.wrong.agree, np.inf, FAR_SIGMAS) * root
        agreed = found.distance_rad_s.clip(-farthest, farthest)
        pushes = forces(self._fans, now, evidence.age_s, evidence.then_rad_s, self._hypotheses.columns)
        farthest = np.where(self.active, AGREED_SIGMAS, FAR_SIGMAS) * root
        learned = agreed.clip(-farthest, farthest)
        takes = np.divide(learned, agreed, out=np.ones(len(root)), where=agreed != 0.0)  # the filter, of a far reading
        evidence.add(pushes, model, found, gain * takes[:, np.newaxis], agreed)
        model.update(found, gain, learned)
        if len(self.alarms.fans):
            self.alarms.take(now, self.bin_s, (np.square(found.distance_rad_s) / found.variance)[self.alarms.fans])
        self.deviation_std_rad_s = np.where(counts, root, self.deviation_std_rad_s)
        self.log_statistic = np.where(counts, evidence.log_statistic(), self.log_statistic)
        return now, pushes

    def _counts(self, one: Bin, now: Inputs) -> Array:
        """Find the samples of a bin that count, (n, fans): all but wrong readings of the tacho."""
        fans, found = self._fans, self.model.innovation(now)
        expected = now.deviation_rad_s - found.distance_rad_s
        of_sample = np.square(fans.noise_rad_s) * (1.0 - 1.0 / np.maximum(now.readings, 1.0))  # of which it is a mean
        of_count = np.where(now.is_new, 0.0, np.square(fans.pulse_rad_s) / 6.0)  # the filter waits for its end
        std = np.sqrt(found.variance + np.where(now.is_balance, 0.0, of_sample + of_count))
        samples = self.operation.samples_rad_s(one, now)
        is_known, is_held = np.isfinite(samples), fans.held_s > 0.0
        # what is not held is judged by the mean of its bin: a fan that vibrates is far on both sides in turn
        distance = np.where(is_known & ~is_held, found.distance_rad_s, samples - expected)
        of_fault = np.where(self.active, expected - self.model.expected_rad_s, 0.0)
        raised = np.where(self.active, (self.number - self._raised) * len(samples), -1)
        counts = self.wrong.counts(np.stack((distance, distance + of_fault)), std, one.another, raised)
        return is_known & counts & (~one.wrong | self.wrong.agree)

    def _raise(self, fan: int, pushes: Array, speed_rad_s: float) -> None:
        """Begin an alarm: the part of the most probable fault that the filter has absorbed is taken out of its healthy
        states, and the fault becomes a state. pushes: (onsets, COLUMNS) of `forces`."""
        evidence, model = self._evidence, self.model
        self.alarms.add(fan, evidence)
        terms = evidence.log_terms(fan)
        onset, fault = (int(index) for index in np.unravel_index(int(np.argmax(terms)), terms.shape))
        columns = np.array(self._hypotheses.faults[fault].columns)
        sizes, of_sizes = self._hypotheses.sizes(evidence.sums, fan, onset, fault)
        makes = evidence.sums.taken(fan, onset)[columns]  # of the states less what the filter has absorbed
        makes[:, FAULT] = pushes[onset, columns] / max(speed_rad_s, SLOWEST_RAD_S)
        model.mean[fan] += sizes @ makes
        model.covariance[fan] += makes.T @ of_sizes @ makes
        self.active[fan], self._over_s[fan] = True, 0.0
        self._peak[fan] = _surely(model.mean[:, FAULT], self._own_variance())[fan]
        self._raised[fan], self.onset[fan] = evidence.number, evidence.began[onset]
        self._forget(fan)

    def _end(self, fan: int) -> None:
        self.alarms.drop(fan)
        model = self.model
        model.mean[fan, FAULT] = 0.0
        model.covariance[fan, FAULT], model.covariance[fan, :, FAULT] = 0.0, 0.0
        self.active[fan] = self.is_returning[fan] = False
        self._forget(fan)

    def _forget(self, fan: int) -> None:
        self._evidence.forget(fan)
        self.log_statistic[fan] = -np.inf

    def _shares(self, now: Inputs) -> Array:
        """Find the share of the present speed that each fault takes of a fan at a steady speed, (fans, faults), if its
        size does not grow."""
        nothing, speed = np.zeros(len(now.speed_rad_s)), now.speed_rad_s[:, np.newaxis]
        steady = replace(now, rate_rad_s2=nothing, moves_rad_s2=nothing)
        pushes = forces(self._fans, steady, np.zeros(1), speed, self._hypotheses.columns)
        first = [BEFORE_GROWTH.get(fault.columns[0], fault.columns[0]) for fault in self._hypotheses.faults]
        return pushes[:, 0, first] / np.maximum(speed, SLOWEST_RAD_S)

    def _own_variance(self) -> Array:
        """Return the variance of the faults of active alarms if the slow states are what they were, (fans,); else 0.

        A slow state moves on while nothing is learned of it, and what it does shows as the fault: that is no change of
        the fault.
        """
        found = np.zeros(len(self.active))
        if self.active.any():
            of_alarms = self.model.covariance[self.active]
            slow, both = of_alarms[:, SLOW, SLOW] + 1e-15 * np.eye(SLOW.stop), of_alarms[:, SLOW, FAULT, np.newaxis]
            explained = (both * np.linalg.solve(slow, both)).sum(axis=(1, 2))
            found[self.active] = (of_alarms[:, FAULT, FAULT] - explained).clip(0.0)
        return found

    def _log_odds(self) -> Array:
        """Log odds, (fans,), of the fault of an alarm against a healthy fan: the fault at its largest, as it shows at
        the present speed."""
        expected = self._peak * self._shows
        return expected * (self.model.mean[:, FAULT] - 0.5 * expected) / np.maximum(self._own_variance(), 1e-12)

    def _is_over(self, known: Array, shares: Array) -> Array:
        """Return where a healthy fan has been more probable than the fault at its largest for OVER_S, (fans,). shares:
        see `_shares`."""
        model, peak = self.model, self._peak
        size, variance = model.mean[:, FAULT], model.covariance[:, FAULT, FAULT]
        surely = _surely(size, self._own_variance())
        is_larger = known & self.active & (np.abs(surely) > np.abs(peak))
        self._peak = np.where(is_larger, surely, peak)
        is_largest = is_larger | (self._raised == self.number)
        self._shape = np.where(is_largest[:, np.newaxis], shares, self._shape)
        if len(self.alarms.fans):
            self._is_probable[self.alarms.fans] = self.alarms.probabilities > PROBABLE
        with np.errstate(divide="ignore", invalid="ignore"):
            shows = np.where(self._is_probable, shares / self._shape, 1.0).min(axis=1, initial=1.0)
        self._shows = np.where(known, np.nan_to_num(shows).clip(0.0), self._shows)
        varies = np.zeros(len(known), np.bool_)
        if len(self.alarms.fans):
            varies[self.alarms.fans] = self.alarms.varies
        is_left = np.abs(size) > LEFT_SIGMAS * np.sqrt(variance)  # on either side
        is_healthy = self.active & ~varies & ~is_left & (self._log_odds() < -math.log(OVER_ODDS))
        self.is_returning = np.where(known, is_healthy, self.is_returning)
        over_s = np.where(is_healthy, self._over_s + self.bin_s * self.operation.bins_held, 0.0)
        self._over_s = np.where(known, over_s, self._over_s)
        found: Array = self._over_s >= OVER_S
        return found


def _surely(size: Array, variance: Array) -> Array:
    """Return the share of the speed that a fault takes at least, with its sign, and not more than all of it."""
    return np.copysign((np.abs(size) - 2.0 * np.sqrt(variance)).clip(SMALLEST), size).clip(-1.0)
