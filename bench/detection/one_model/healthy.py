"""The model of a healthy fan: what may make its speed differ from the prediction of its twin.

With w the speed, w' its rate, both as the twin predicts them, a healthy fan in bin k deviates from its twin by

    s = w (h(w).theta + load sag + c + v + u + f) - rise w'+ - fall w'-  what it tends to
    x = keep x + (1 - keep) s,   keep = exp(-bin / time constant)        its rotor follows
    y = mean of x - late w' + e_k - e_k-1 + white                        and its tacho shows

    theta       share of the speed   error of the twin over speed (hat functions on KNOTS); grows slowly with age
    rise, fall  s                    errors of its time constants
    late        s                    how late the tacho shows the speed, other than when the twin was trained
    sag         share                what the load of the other fans of the tray does to the supply
    c           share                what the air does: an Ornstein-Uhlenbeck process over an hour
    v           share                what theta does not resolve: it stays while speed and command stay
    u           share                the wandering of the speed: an Ornstein-Uhlenbeck process over seconds
    f           share                what a fault takes: 0, and a random walk while there is an alarm
    x, mean     rad/s                deviation of the rotor at the end of the bin, and its mean over the bin
    q           rad/s                s as the torque balance shows it, which passes the filter of the balance
    e           rad/s                part of a pulse that a count misses; the next count has it

The time constant is that of the twin's torque balance, J w' = torque - viscous w - drag w|w| - friction: the deviation
of two solutions of it decays with (viscous + drag (w + w_twin)) / J. So one state joins both residuals: the speed
shows x, and the torque balance what x tends to. Where the free run is not known, or is known worse, the balance is
what is read.

A Kalman filter gives the innovations and their variance. All that is uncertain is in it: twin, few data, air, motion,
counts. Nothing else widens a limit.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from bench.detection.one_model.operation import Fans, Inputs
from schemas.messages import Array

KNOTS = np.array([0.09, 0.14, 0.2, 0.28, 0.38, 0.5, 0.63, 0.77, 0.9, 1.02])
"""shares of the top speed"""
K = len(KNOTS)
RISE, FALL, LATE, SAG, AIR, LOCAL, WANDER, FAULT, ROTOR, SHOWN, BALANCE, COUNT, COUNT_BEFORE = range(K, K + 13)
STATES = K + 13
SLOW = slice(WANDER)
"""the states that stay what they are during a fault"""
FOLLOWING = slice(ROTOR, BALANCE + 1)
"""the states that follow what a fan tends to"""
SLOWEST_RAD_S = 10.0
"""errors in rad/s are no larger share of a lower speed"""


@dataclass(frozen=True)
class Priors:
    """Standard deviations, of a population of fans, and how fast they change."""

    twin_share: float = 0.02
    """error of a twin that is common to all speeds"""
    twin_rad_s: float = 1.5
    """and one that differs over `twin_length`, share of the top speed"""
    twin_length: float = 0.12
    largest_twin_share: float = 0.1
    plateau: float = 0.05
    """error, share of the top speed, of a twin that does not know a plateau, at speeds below `plateau_ends`"""
    plateau_ends: float = 0.17
    ageing_per_sqrt_h: float = 0.002
    lag_s: float = 0.15
    """error of a time constant; as much is new after moving over the whole range"""
    sag: float = 0.02
    air: float = 0.01
    air_s: float = 3600.0
    local_rad_s: float = 0.45
    local_length: float = 0.1
    """share of the top speed, or of the commands, after which the local error is another"""
    local_s: float = 2000.0
    wander: float = 0.0025
    wander_s: float = 2.0
    count: float = 0.7
    """share of the error of a count: counts that follow one another are not independent"""
    half_range: float = 0.25
    """white error, of half the range of readings that the tacho may show"""
    rate_s: float = 0.1
    """white error, of the rate of the predicted speed"""
    balance: float = 0.3
    """white error, of the noise of the torque balance; the rest passes its filter"""


def hats(share: Array) -> Array:
    """(n, K) hat functions on KNOTS at shares of the top speed, (n,)."""
    place = np.interp(share, KNOTS, np.arange(K))
    return np.maximum(0.0, 1.0 - np.abs(place[:, np.newaxis] - np.arange(K)))


@dataclass(frozen=True, eq=False)
class Innovation:
    """What the readings of a bin tell: how far each is from what was expected, (fans,), and how sure that was."""

    distance_rad_s: Array
    variance: Array
    with_states: Array
    """(fans, STATES) covariance of the states with the reading"""
    shown: Array
    """(fans,) the state that is read"""
    counts_pulses: Array
    """(fans,) 1 where a part of a pulse may be missed, 0 where not"""


class HealthyFans:
    """The filter, all fans as columns of one state: mean (fans, STATES) and covariance (fans, STATES, STATES)."""

    def __init__(self, fans: Fans, priors: Priors, bin_s: float, period_s: float) -> None:
        """Begin with the priors. period_s: of the samples."""
        self._fans, self._priors, self._bin_s = fans, priors, bin_s
        count = len(fans.top_rad_s)
        self._columns = np.arange(count)
        self.mean = np.zeros((count, STATES))
        self.covariance = _prior(fans, priors, period_s)
        self.kept = np.ones((count, STATES))
        """(fans, STATES) of each state from one bin to the next"""
        self.tends = np.zeros((count, 3, STATES))
        """rows of ROTOR, SHOWN and BALANCE: these are the rows times the states before"""
        self.follows = np.ones((count, 3))
        """how far they go to what a fan tends to in a bin"""
        self._has_begun = np.zeros(count, np.bool_)
        """(fans,) whether there was a reading: at the first one a rotor is where it tends to"""
        self.counted = np.arange(0)
        """the fans with a new reading"""
        self._of_balance = 1.0 - math.exp(-bin_s * fans.balance_filter_per_s)
        self.kept[:, WANDER], self.kept[:, AIR] = np.exp(-bin_s / priors.wander_s), np.exp(-bin_s / priors.air_s)
        self.noise = np.zeros((count, STATES))
        """(fans, STATES) variance that a bin adds"""
        self.noise[:, :K] = priors.ageing_per_sqrt_h**2 * bin_s / 3600.0
        self.noise[:, WANDER] = priors.wander**2 * (1.0 - self.kept[:, WANDER] ** 2)
        self.noise[:, AIR] = priors.air**2 * (1.0 - self.kept[:, AIR] ** 2)
        self._missed = np.square(priors.count * fans.pulse_rad_s) / 12.0

    def of(self, fan: int) -> HealthyFans:
        """A copy for one fan."""
        copied = HealthyFans(self._fans.of(fan), self._priors, self._bin_s, 0.0)
        copied.mean, copied.covariance = self.mean[[fan]], self.covariance[[fan]]
        copied._has_begun = self._has_begun[[fan]]
        return copied

    def predict(self, now: Inputs) -> None:
        """Go on by one bin."""
        p, fans, mean, covariance = self._priors, self._fans, self.mean, self.covariance
        moved = np.abs(now.rate_rad_s2) * self._bin_s / fans.top_rad_s
        stays = np.exp(-(moved + now.turned) / p.local_length - self._bin_s / p.local_s)
        self.kept[:, LOCAL] = stays
        is_new = now.readings > 0
        self.counted = np.flatnonzero(is_new)
        self.kept[:, COUNT] = ~is_new
        mean[is_new, COUNT_BEFORE] = mean[is_new, COUNT]
        covariance[is_new, COUNT_BEFORE, :] = covariance[is_new, COUNT, :]
        covariance[is_new, :, COUNT_BEFORE] = covariance[is_new, :, COUNT]
        mean *= self.kept
        covariance *= self.kept[:, :, np.newaxis]
        covariance *= self.kept[:, np.newaxis, :]
        variance = np.einsum("nii->ni", covariance)  # a view
        variance += self.noise
        variance[:, COUNT] += is_new * self._missed
        new = (p.local_rad_s**2 + now.unseen_rad_s**2) / np.square(np.maximum(now.speed_rad_s, SLOWEST_RAD_S))
        variance[:, LOCAL] += new * (1.0 - stays**2)
        for lag in (RISE, FALL):
            walked = np.minimum(variance[:, lag] + p.lag_s**2 * moved, (2.0 * p.lag_s) ** 2)
            variance[:, lag] = np.maximum(variance[:, lag], walked)
        self._follow(now)
        with_states = self.tends @ covariance
        own = with_states @ self.tends.swapaxes(1, 2)
        of_balance = np.square(fans.balance_noise / fans.slope(now.speed_rad_s))
        own[:, 2, 2] += of_balance * (1.0 - np.square(1.0 - self.follows[:, 2]))
        mean[:, FOLLOWING] = (self.tends @ mean[:, :, np.newaxis])[:, :, 0]
        covariance[:, FOLLOWING, :] = with_states
        covariance[:, :, FOLLOWING] = with_states.swapaxes(1, 2)
        covariance[:, FOLLOWING, FOLLOWING] = own

    def _follow(self, now: Inputs) -> None:
        """Set how rotor and balance follow what the fan tends to at this speed."""
        fans, speed = self._fans, now.speed_rad_s
        decay = np.maximum(fans.viscous + fans.drag * (now.measured_rad_s + speed), 1e-9) / fans.inertia * self._bin_s
        self.follows[:, 0] = -np.expm1(-decay)
        self.follows[:, 1] = 1.0 - self.follows[:, 0] / decay  # the mean over the bin
        self.follows[:, 2] = self._of_balance
        begins = (now.readings > 0) & ~self._has_begun
        self.follows[begins] = 1.0
        self._has_begun |= begins
        steady = np.zeros((len(speed), STATES))
        steady[:, :K] = speed[:, np.newaxis] * hats(speed / fans.top_rad_s)
        steady[:, RISE], steady[:, FALL] = -now.moves_rad_s2.clip(0.0), -now.moves_rad_s2.clip(None, 0.0)
        steady[:, SAG] = speed * now.load
        steady[:, AIR] = steady[:, LOCAL] = steady[:, WANDER] = steady[:, FAULT] = speed
        self.tends[:] = self.follows[:, :, np.newaxis] * steady[:, np.newaxis, :]
        self.tends[:, :2, ROTOR] = 1.0 - self.follows[:, :2]
        self.tends[:, 1, LATE] = -now.moves_rad_s2
        self.tends[:, 2, BALANCE] = 1.0 - self.follows[:, 2]

    def innovation(self, now: Inputs) -> Innovation:
        """What the readings of the bin tell."""
        p, fans, covariance, mean, columns = self._priors, self._fans, self.covariance, self.mean, self._columns
        shown = np.where(now.is_balance, BALANCE, SHOWN)
        counts = np.where(now.is_balance, 0.0, 1.0)
        with_states = covariance[columns, shown] + counts[:, np.newaxis] * (
            covariance[:, COUNT] - covariance[:, COUNT_BEFORE]
        )
        variance = with_states[columns, shown] + counts * (with_states[:, COUNT] - with_states[:, COUNT_BEFORE])
        of_balance = np.square(p.balance * fans.balance_noise / fans.slope(now.speed_rad_s))
        of_speed = np.square(fans.noise_rad_s) / np.maximum(now.readings, 1.0)
        of_speed += np.square(p.half_range * now.half_range_rad_s) + np.square(p.rate_s * now.rate_rad_s2)
        expected = mean[columns, shown] + counts * (mean[:, COUNT] - mean[:, COUNT_BEFORE])
        return Innovation(
            np.where(now.readings > 0, now.deviation_rad_s - expected, 0.0),
            variance + np.where(now.is_balance, of_balance, of_speed),
            with_states,
            shown,
            counts,
        )

    def update(self, found: Innovation, gain: Array, distance_rad_s: Array) -> None:
        """Take the readings up. gain: (fans, STATES), 0 where nothing is learned; distance: as far as it counts."""
        self.mean += gain * distance_rad_s[:, np.newaxis]
        cross = gain[:, :, np.newaxis] * found.with_states[:, np.newaxis, :]
        weighed = gain * found.variance[:, np.newaxis]
        self.covariance += gain[:, :, np.newaxis] * weighed[:, np.newaxis, :] - cross - cross.swapaxes(1, 2)


def _prior(fans: Fans, p: Priors, period_s: float) -> Array:
    top = fans.top_rad_s
    covariance = np.zeros((len(top), STATES, STATES))
    near = np.exp(-0.5 * np.square((KNOTS[:, np.newaxis] - KNOTS) / p.twin_length))
    local = np.minimum(p.twin_rad_s / (KNOTS * top[:, np.newaxis]), p.largest_twin_share)
    covariance[:, :K, :K] = p.twin_share**2 + near * local[:, :, np.newaxis] * local[:, np.newaxis, :]
    covariance[:, :K, :K] += 1e-8 * np.eye(K)
    low = fans.may_have_plateau[:, np.newaxis] * np.where(p.plateau_ends > KNOTS, p.plateau / KNOTS, 0.0)
    covariance[:, :K, :K] += low[:, :, np.newaxis] * low[:, np.newaxis, :]
    for state, std in ((RISE, p.lag_s), (FALL, p.lag_s), (SAG, p.sag), (AIR, p.air), (WANDER, p.wander)):
        covariance[:, state, state] = std**2
    phase_s = (fans.held_s + period_s) / math.sqrt(6.0)  # of window and sample: two phases, then and now
    covariance[:, LATE, LATE] = np.square(phase_s)
    covariance[:, LOCAL, LOCAL] = np.square(p.local_rad_s / (0.5 * top))
    return covariance
