"""Model of a healthy fan: what may make its speed differ from the prediction of its twin.

With w the speed, w' its rate, both as the twin predicts them, a healthy fan in bin k deviates from its twin by

    s = w (h(w).theta + load sag + a + c + v + u + f) - rise w'+ - fall w'-  its steady speed
    x = keep x + (1 - keep) s,   keep = exp(-bin / time constant)        its rotor follows
    y = mean of x - late w' - e_k-1 + e_k + white                        and its tacho shows

    theta       share of the speed   error of the twin over speed (hat functions on KNOTS)
    rise, fall  s                    errors of its time constants
    late        s                    how late the tacho shows the speed, other than when the twin was trained
    sag         share                what the load of the other fans of the tray does to the supply
    a           share                wear: how the fan changes within days and months, a random walk
    c           share                what the air does: an Ornstein-Uhlenbeck process over an hour
    v           share                what theta does not resolve: constant at one speed and command
    u           share                the wandering of the speed: an Ornstein-Uhlenbeck process over seconds
    f           share                what a fault takes: 0, and a random walk while there is an alarm
    e           rad/s                part of a pulse that a count misses; the next count has it, if it adjoins. Where
                                     samples leave out windows, the error of a count, y = mean of x - late w' - e: what
                                     two counts in a row have in common of it follows from how far counts differ
    x, mean     rad/s                deviation of the rotor at the end of the bin, and its mean over the bin;
                                     a command that has moved since the last sample may have done so at any time since
    q           rad/s                s as the torque balance shows it, which passes the filter of the balance

The time constant is that of the twin's torque balance, J w' = torque - viscous w - drag w|w| - friction: the deviation
of two solutions of it decays with (viscous + drag (w + w_twin)) / J. So one state joins both residuals: the speed shows
x, and the torque balance s. In each bin one of them is read: the balance where the free run is not known, or where the
balance has much less noise.

A Kalman filter gives the innovations and their variance. All that is uncertain is in it: twin, few data, air, motion,
counts. Nothing else widens a limit.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from fantwin.schemas.messages import Array
from fantwin.scoring.model.operation import Fans, Inputs
from fantwin.scoring.model.population import Priors
from fantwin.scoring.saved import Saved

KNOTS = np.array([0.09, 0.14, 0.2, 0.28, 0.38, 0.5, 0.63, 0.77, 0.9, 1.02])
"""shares of the top speed"""
K = len(KNOTS)
RISE, FALL, LATE, SAG, AGE, AIR, LOCAL, WANDER, FAULT, COUNT, ROTOR, BALANCE, SHOWN = range(K, K + 13)
STATES = K + 13
SLOW = slice(WANDER)
"""states that are frozen during a fault"""
FADING = slice(AIR, WANDER + 1)
"""states that decay; a bin keeps a share of each"""
FOLLOWING = slice(ROTOR, SHOWN + 1)
"""states that follow the steady speed"""
HALF = np.tril_indices(STATES)
CARRIED = SHOWN
"""number of states that the next bin depends on: all but SHOWN, what a tacho shows without e_k and white noise"""
BOTH_BUT_NOT = np.array([[1.0], [-1.0]])
"""signs of the outer products in `update`: the covariance of two states that learn nothing is not reduced"""
UNSEEN_S = 100.0
"""time constant of the unseen error: how heat and supply act there is not known, either"""
MISSED = 1.0 / 6.0
"""variance of the error of a count, pulses, where its window begins at any phase"""
UNRELATED = 2.0 * MISSED
"""mean square of the difference of two counts, pulses, whose errors are not related"""
TURNS = 8.0
"""number of counts over which their differences are averaged"""
SLOWEST_RAD_S = 10.0
"""lowest speed by which an error in rad/s is divided to make it a share"""


def hats(share: Array) -> Array:
    """Hat functions on KNOTS at shares of the top speed, (n,), as (n, K)."""
    place = np.interp(share, KNOTS, np.arange(K))
    return np.maximum(0.0, 1.0 - np.abs(place[:, np.newaxis] - np.arange(K)))


@dataclass(frozen=True, eq=False)
class Innovation:
    """Innovation of the readings of a bin: distance of each from the expected one, (fans,), and its variance."""

    distance_rad_s: Array
    variance: Array
    with_states: Array
    """(fans, STATES) covariance of the states with the reading"""
    shown: Array
    """(fans,) the state that is read"""


class HealthyFans(Saved):
    """The filter, all fans as columns of one state: mean (fans, STATES) and covariance (fans, STATES, STATES)."""

    KEPT = ("mean", "half_covariance", "_has_begun", "_turns", "_before_rad_s")
    OF_FANS = ("mean", "covariance", "_has_begun", "_turns", "_before_rad_s")

    def __init__(self, fans: Fans, priors: Priors, bin_s: float, period_s: float) -> None:
        """Begin with the priors. period_s: of the samples."""
        self.fans, self._priors, self._bin_s, self._period_s = fans, priors, bin_s, period_s
        count = len(fans.top_rad_s)
        self._rows = np.arange(count)
        self.mean = np.zeros((count, STATES))
        self.covariance = _prior(fans, priors, period_s)
        self.kept = np.ones((count, 3))
        """(fans, 3) share of FADING that a bin keeps"""
        self.tends = np.zeros((count, 3, STATES))
        """(fans, 3, STATES) rows that give the states FOLLOWING from the states before"""
        self.follows = np.ones((count, 3))
        """(fans, 3) share of the distance to the steady speed that each goes in a bin"""
        self._has_begun = np.zeros(count, np.bool_)
        """(fans,) true after the first reading, at which a rotor is at its steady speed"""
        self._holds = np.ones(count)
        """(fans,) 1 where no reading ends, so that the error of the last count is kept"""
        self._filters = 1.0 - math.exp(-bin_s * fans.balance_filter_per_s)
        self.kept[:, WANDER - AIR], self.kept[:, 0] = np.exp(-bin_s / priors.wander_s), np.exp(-bin_s / priors.air_s)
        self.noise = np.zeros((count, STATES))
        """(fans, STATES) variance that a bin adds"""
        self.noise[:, AGE] = priors.ageing_per_sqrt_h**2 * bin_s / 3600.0
        self.noise[:, WANDER] = priors.wander**2 * (1.0 - self.kept[:, WANDER - AIR] ** 2)
        self.noise[:, AIR] = priors.air**2 * (1.0 - self.kept[:, 0] ** 2)
        self._skips = _skips(fans, period_s)
        """(fans,) true where samples leave out windows of the tacho"""
        self._turns = np.full(count, UNRELATED)
        """(fans,) mean square of the difference of two counts in a row, pulses, over the last TURNS of them"""
        self._before_rad_s = np.zeros(count)
        """(fans,) deviation of the last reading from the free run"""
        self._missed = _missed(fans, priors, period_s)
        self._adjoins = fans.adjoins & (fans.held_s > 0.75 * bin_s)
        """(fans,) true where each count begins where the one before ended, and no bin contains two"""
        self._remembers = self._adjoins.astype(np.float64)
        """(fans,) 1 where the error of a count is in the next bin's"""
        self._ahead = np.zeros(count)
        """(fans,) share of a movement of the command by which a rotor may be ahead of the twin, standard deviation: the
        command has moved at any time within the period before its sample"""
        self._of_balance = np.zeros(count)
        """(fans,) variance of the noise of the torque balance, as speed"""
        self.tends[:, SHOWN - ROTOR, COUNT] = -1.0
        self.steady = np.zeros((count, COUNT))
        """(fans, COUNT) factors of the states in the steady speed"""

    def of(self, fans: Array) -> HealthyFans:
        """A copy for some fans, (n,) by number."""
        copied = HealthyFans(self.fans.of(fans), self._priors, self._bin_s, self._period_s)
        for name in self.OF_FANS:
            setattr(copied, name, getattr(self, name)[fans])
        return copied

    def continue_as(self, other: HealthyFans) -> None:
        """Take the states of the first fans from another of fewer fans."""
        for name in self.OF_FANS:
            getattr(self, name)[: len(other.mean)] = getattr(other, name)

    @property
    def half_covariance(self) -> Array:
        """Lower triangles of `covariance`, one after another: it is symmetric."""
        half: Array = self.covariance[:, *HALF]
        return half

    @half_covariance.setter
    def half_covariance(self, half: Array) -> None:
        self.covariance[:, *HALF] = half
        self.covariance[:, *HALF[::-1]] = half

    def begin_again(self, fan: int) -> None:
        """Return a fan to the priors."""
        self.mean[fan], self._has_begun[fan] = 0.0, False
        self._turns[fan], self._before_rad_s[fan] = UNRELATED, 0.0
        self.covariance[fan] = _prior(self.fans.of(np.array([fan])), self._priors, self._period_s)[0]

    def rest(self, bins: int) -> None:
        """Let time pass in which nothing is known: at the next reading a rotor is at its steady speed."""
        passed_s, p = bins * self._bin_s, self._priors
        kept = np.ones(STATES)
        kept[LOCAL], kept[WANDER] = math.exp(-passed_s / p.local_s), math.exp(-passed_s / p.wander_s)
        kept[AIR], kept[COUNT] = math.exp(-passed_s / p.air_s), 0.0
        self.mean *= kept
        self.covariance *= kept[:, np.newaxis] * kept
        variance = np.einsum("nii->ni", self.covariance)  # a view
        variance[:, AGE] += p.ageing_per_sqrt_h**2 * passed_s / 3600.0
        variance[:, COUNT] = self._missed
        for state, std in ((WANDER, p.wander), (AIR, p.air)):
            variance[:, state] += std**2 * (1.0 - kept[state] ** 2)
        variance[:, LOCAL] += np.square(p.local_rad_s / (0.5 * self.fans.top_rad_s)) * (1.0 - kept[LOCAL] ** 2)
        self._has_begun[:] = False

    @property
    def expected_rad_s(self) -> Array:
        """Expected deviation of a healthy fan from its twin at the present speed, (fans,)."""
        return np.asarray(np.einsum("ni,ni->n", self.steady[:, :FAULT], self.mean[:, :FAULT]))

    @property
    def age(self) -> tuple[Array, Array]:
        """Change (fans,) of each fan since its beginning, + faster, and its standard deviation: shares of the speed."""
        return self.mean[:, AGE].copy(), np.sqrt(self.covariance[:, AGE, AGE])

    def predict(self, now: Inputs) -> None:
        """Go on by one bin."""
        p, covariance = self._priors, self.covariance
        moved = np.abs(now.moves_rad_s2) * self._bin_s / self.fans.top_rad_s
        variances = np.stack((now.of_lowest_rad_s, now.unseen_rad_s)) ** 2
        local = p.local_rad_s**2 + variances.sum(axis=0)
        is_of_lowest, is_unseen = variances / local
        # what is unseen is not renewed by the speed: a fault must not widen what is not known of a fan
        path = now.command_moved + (1.0 - is_unseen) * moved + is_of_lowest * now.command_path
        per_s = (1.0 - is_unseen) / p.local_s + is_unseen / UNSEEN_S
        remains = np.exp(-path / p.local_length - self._bin_s * per_s)
        self.kept[:, LOCAL - AIR] = remains
        self.noise[:, LOCAL] = local / np.square(np.maximum(now.speed_rad_s, SLOWEST_RAD_S)) * (1.0 - remains**2)
        faded = covariance[:, FADING] * self.kept[:, :, np.newaxis]
        faded[:, :, FADING] *= self.kept[:, np.newaxis, :]
        covariance[:, FADING], covariance[:, :, FADING] = faded, faded.swapaxes(1, 2)
        variance = covariance.reshape(len(remains), -1)[:, :: STATES + 1]  # a view
        variance += self.noise
        lags = variance[:, RISE : FALL + 1]
        walked = np.minimum(lags + (p.lag_s**2 * moved)[:, np.newaxis], (2.0 * p.lag_s) ** 2)
        np.maximum(lags, walked, out=lags)
        self._follow(now)
        self._remembers = np.where(self._skips, self._common(now), self._adjoins)
        variance[:, ROTOR] += np.square(self._ahead * now.command_moved * self.fans.top_rad_s)
        covariance[:, COUNT] *= self._remembers[:, np.newaxis]
        covariance[:, :, COUNT] *= self._remembers[:, np.newaxis]
        covariance[:, COUNT, COUNT] += (1.0 - np.square(self._remembers)) * self._missed
        with_states = self.tends @ covariance
        own = with_states @ self.tends.swapaxes(1, 2)
        self._of_balance = np.square(self.fans.balance_noise / self.fans.slope(now.speed_rad_s))
        own[:, 1, 1] += self._of_balance * (1.0 - np.square(1.0 - self.follows[:, 1]))
        covariance[:, FOLLOWING] = with_states
        covariance[:, :, FOLLOWING] = with_states.swapaxes(1, 2)
        covariance[:, FOLLOWING, FOLLOWING] = own
        covariance[:, COUNT] *= self._holds[:, np.newaxis]
        covariance[:, :, COUNT] *= self._holds[:, np.newaxis]
        covariance[:, COUNT, COUNT] += (1.0 - self._holds) * self._missed
        self.carry(self.mean[:, :, np.newaxis])

    def carry(self, states: Array) -> None:
        """Take (fans, STATES, n) states on to the present bin."""
        states[:, FADING] *= self.kept[:, :, np.newaxis]
        states[:, COUNT] *= self._remembers[:, np.newaxis]
        states[:, FOLLOWING] = self.tends.astype(states.dtype, copy=False) @ states
        states[:, COUNT] *= self._holds[:, np.newaxis]

    def _common(self, now: Inputs) -> Array:
        """Return the share of the error of the last count that the present one has, (fans,), where samples leave out
        windows.

        A count of a speed that makes p of a pulse more than whole ones errs by -p or 1 - p. If two counts in a row
        differ with the probability c, their errors correlate by 1 - c / (2 p (1 - p)). So they do not where windows
        begin at any phase, and fully where a fan makes whole pulses between two samples.
        """
        pulse = np.where(self._skips, self.fans.pulse_rad_s, np.inf)
        turned = np.minimum(np.square((now.deviation_rad_s - self._before_rad_s) / pulse), 1.0)
        known = now.readings > 0
        correlation = (1.0 - self._turns / UNRELATED).clip(0.0)
        # a count that stays while the speed moves errs by as much more
        share = np.sqrt((np.square(correlation) - turned / MISSED).clip(0.0)) * ~now.changes
        self._turns = np.where(known, self._turns + (turned - self._turns) / TURNS, self._turns)
        self._before_rad_s = np.where(known, now.deviation_rad_s, self._before_rad_s)
        return np.where(known, share, 1.0)

    def _follow(self, now: Inputs) -> None:
        """Set how rotor, balance and tacho follow the steady speed of the fan."""
        fans, speed, tends, follows = self.fans, now.speed_rad_s, self.tends, self.follows
        decay = np.maximum(fans.viscous + fans.drag * (now.measured_rad_s + speed), 1e-9) / fans.inertia * self._bin_s
        follows[:, 0], follows[:, 1] = -np.expm1(-decay), self._filters
        follows[:, 2] = 1.0 - follows[:, 0] / decay  # the mean over the bin
        self._ahead = -np.expm1(-decay * self._period_s / self._bin_s / math.sqrt(12.0))
        self._ahead *= fans.may_be_ahead
        is_new = now.is_new
        self._holds = 1.0 - ((is_new | now.ends) & ~self._skips)
        begins = is_new & ~self._has_begun
        if begins.any():
            follows[begins] = 1.0
            self._has_begun |= begins
        steady, moves = self.steady, now.moves_rad_s2
        np.multiply(hats(speed / fans.top_rad_s), speed[:, np.newaxis], out=steady[:, :K])
        np.minimum(-moves, 0.0, out=steady[:, RISE])
        np.maximum(-moves, 0.0, out=steady[:, FALL])
        np.multiply(speed, now.load, out=steady[:, SAG])
        steady[:, AGE:] = speed[:, np.newaxis]
        np.multiply(follows[:, :, np.newaxis], steady[:, np.newaxis, :], out=tends[:, :, :COUNT])
        tends[:, ::2, ROTOR] = 1.0 - follows[:, ::2]
        tends[:, 1, BALANCE] = 1.0 - follows[:, 1]
        tends[:, 2, LATE] = -moves

    def innovation(self, now: Inputs) -> Innovation:
        """Innovation of the readings of the bin."""
        p, fans = self._priors, self.fans
        shown = np.where(now.is_balance, BALANCE, SHOWN)
        with_states = self.covariance[self._rows, shown]
        white = np.square(fans.noise_rad_s) / np.maximum(now.readings, 1.0)
        white += np.square(p.half_range * now.half_range_rad_s) + np.square(fans.timing_s * now.rate_rad_s2)
        missed = np.where(now.is_balance | self._skips, 0.0, self._missed)
        of_balance = p.balance**2 * self._of_balance + np.square(p.balance_time_s * now.moves_rad_s2)
        white = np.where(now.is_balance, of_balance, white + missed)
        variance = with_states[self._rows, shown] + white
        with_states[:, COUNT] += missed
        expected = self.mean[self._rows, shown]
        distance = np.where(now.readings > 0, now.deviation_rad_s - expected, 0.0)
        return Innovation(distance, variance, with_states, shown)

    def update(self, found: Innovation, gain: Array, distance_rad_s: Array) -> None:
        """Update the states by the readings. gain: (fans, STATES), with_states over variance, or 0 where nothing is
        learned; distance_rad_s: (fans,), clipped."""
        self.mean += gain * distance_rad_s[:, np.newaxis]
        halves = np.empty((len(gain), STATES, 2))
        np.divide(found.with_states, np.sqrt(found.variance)[:, np.newaxis], out=halves[:, :, 0])
        np.multiply(halves[:, :, 0], gain == 0.0, out=halves[:, :, 1])
        self.covariance -= halves @ np.multiply(halves.swapaxes(1, 2), BOTH_BUT_NOT, order="C")


def _skips(fans: Fans, period_s: float) -> Array:
    return (fans.pulse_rad_s > 0.0) & (fans.held_s < 0.75 * period_s)


def _missed(fans: Fans, p: Priors, period_s: float) -> Array:
    """Variance of the part of a pulse that a count misses, (fans,); of two such parts where they are not related."""
    of_both = MISSED * np.square(fans.pulse_rad_s)
    return np.where(_skips(fans, period_s), of_both, np.square(p.count * fans.pulse_rad_s) / 12.0)


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
    covariance[:, COUNT, COUNT] = _missed(fans, p, period_s)
    covariance[:, LOCAL, LOCAL] = np.square(p.local_rad_s / (0.5 * top))
    return covariance
