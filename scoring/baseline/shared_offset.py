"""What the fans of a tray have in common: the air of the room and the supply shift all of them, and none is faulty.

The part that the offsets of most fans have in common, as a share of the speed, is subtracted from every residual. It
moves no further than to the nearer of the two offsets in the middle: of three fans to their median, of two or four only
if it lies outside of the (inner) two. So one fan that is off by itself does not take it along. It is limited
(HealthyResidual.shared_limit): more than weather is left in the residual of every fan.

Until the first fan has its baseline, offsets are residuals as they are, and the shared one follows their mean at once:
baselines are then found without it. A baseline that took a share of the speed as its own would be wrong at all other
speeds. Idling fans say little about a share of the speed. Where at least two others turn fast, only these are compared.
And if all were commissioned at low speed, the offset from which the limit is measured is found again, within bounds,
when they first turn faster.

While only one of the fans turns it cannot be compared. Then the shared offset takes the place of the fan's own
baseline, as slow and with as short a reach: otherwise both would have followed the same weather when the others turn
again.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from schemas.messages import Array
from scoring.baseline.intervals import Intervals, first_end
from scoring.column_state import ColumnState

SMOOTHING_S = 8.0  # longer than a tacho counts, shorter than supply and air take to change by much
LEAST_FANS = 2
MIN_RELATIVE_SPEED = 0.5  # of the second fastest fan, in sigmas: residuals of slower ones are mostly errors of the twin
MIN_VALID_SHARE = 0.5  # of an interval's samples
# Information, 0 to 1, is what an interval says of a share of the speed beside the ridge: 0.5 where both say as much.
WELL_KNOWN = 0.8  # information at the commissioning from which its value is not looked for again
LEAST_INFORMATION = 0.5  # of an interval in which it is looked for
MORE_INFORMATION = 0.1  # at least so much more than at the commissioning
ENOUGH_INFORMATION = 60.0  # the sum, beyond these, after which it stays
SEARCHED_S = 86400.0  # and it stays after so long with fans that could be compared
LARGEST_SIGMAS = 1e3  # larger offsets are clipped to this
FIXED_POINT_ONE = 1 << 6  # integer sums do not depend on how samples are cut


class SharedOverIntervals(NamedTuple):
    """What fans share in successive intervals."""

    values: Array
    """(intervals, 1), or (intervals, fans) of several trays: the offset for each rad/s, in each"""
    states: Array
    """(intervals, 5) the state in each, see _State; of one tray"""
    products: Array
    squares: Array
    counts: Array
    """(intervals, fans) the sums of each; in the first with those before"""
    ends: int
    """so many of the intervals these hold for"""


class _State(NamedTuple):
    """What is shared, for each rad/s; see the columns of SharedOffset."""

    value: float
    compared: float
    commissioned: float
    informed: float
    searched: float


class SharedOffset(ColumnState):
    """The offset that the fans of a tray share, of one residual, for each rad/s of their speed."""

    def __init__(
        self,
        fans: int,
        *,
        limit: float,
        residual_std: float,
        interval_s: float,
        adaptation_s: float,
        reach_sigmas: float,
    ) -> None:
        """limit: of the offset, for each rad/s. residual_std: of the healthy residual, sigma. interval_s: length of an
        interval. adaptation_s, reach_sigmas: time constant and limit of the movement of a fan's baseline.

        Offsets at low speed are drawn towards zero, or what was shared when all fans were commissioned again (ridge
        regression): errors of the twin there, as large as half of its residual, must not become large offsets at high
        speed. `limit` is two standard deviations of the shared one.
        """
        self.limit = limit
        self.ridge = (residual_std / limit) ** 2
        self.gain, self._gain_alone = (-np.expm1(-interval_s / time_s) for time_s in (SMOOTHING_S, adaptation_s))
        self._reach_sigmas = reach_sigmas
        self._most_searched = SEARCHED_S / interval_s
        self.value = np.zeros(1)
        self.compared = np.zeros(1)
        """the value when fans were last compared"""
        self.commissioned = np.zeros(1)
        """what fans shared when the first of them got its baseline, or all were commissioned again, as far as it is
        known; the limit is from there"""
        self._informed, self._searched = np.zeros((2, 1))
        """since then: the sum of the information from which it was found again, and the intervals searched"""
        self._begun, self._begun_information = np.zeros((2, 1))
        """its value at that time, and how much of it was known, 0 to 1: it may still move by the rest, in limits"""
        self._first = np.zeros(1, np.int64)
        """intervals in which fans were compared before any of them had a baseline"""
        self.products = np.zeros(fans, np.int64)
        self.squares = np.zeros(fans, np.int64)
        self.counts = np.zeros(fans, np.int64)

    @property
    def since_commissioning(self) -> float:
        """How far the offset was from that of the last commissioning of all fans when fans were last compared, for each
        rad/s, in the unit of the residual: what only one fan that turned alone has added since is not shared.
        """
        return float(self.compared[0] - self.commissioned[0])

    @property
    def is_known(self) -> bool:
        """Whether fans were compared before any of them had a baseline."""
        return bool(self._first[0])

    @property
    def independent_intervals(self) -> float:
        """The number of independent intervals of a fan whose mean would vary as much."""
        return (2.0 / self.gain - 1.0) * len(self.counts)

    def over(
        self,
        offset: Array,
        speed_sigmas: Array,
        valid: Array,
        intervals: Intervals,
        commissioned: Array,
        moving: Array | None,
    ) -> SharedOverIntervals:
        """What is shared in the present interval and later ones, if each but the last ends as `end_interval` ends it.

        offset: (n, fans) from the commissioned baseline, sigma. speed_sigmas: (n, fans) the speed over sigma, with its
        sign. commissioned: (fans,). moving: (intervals, fans), see `end_interval`; None for a single interval, which
        does not end here.
        """
        products, squares, counts = sums(offset, speed_sigmas, valid, intervals)
        products[0] += self.products
        squares[0] += self.squares
        counts[0] += self.counts
        states, ends = self._states(products, squares, counts, intervals.expected, commissioned, moving)
        return SharedOverIntervals(states[:, :1], states, products, squares, counts, ends)

    def _states(
        self,
        products: Array,
        squares: Array,
        counts: Array,
        expected: int,
        commissioned: Array,
        moving: Array | None,
    ) -> tuple[Array, int]:
        """(intervals, 5) the state in each, see _State; and up to which these hold: until the end of the first interval
        in which a fan turned alone, itself counted."""
        state = self.now
        if moving is None:
            return np.array([state]), 1
        known = (counts >= MIN_VALID_SHARE * expected) & (squares > 0) & ~moving
        turning = known.sum(axis=1)
        is_compared = turning >= LEAST_FANS
        alone = (turning > 0) & ~is_compared & (commissioned.sum() >= LEAST_FANS)
        fast = self.fast(known, squares, counts)
        ridge = self.ridge * FIXED_POINT_ONE * counts
        states, k = np.empty((len(counts), len(state))), 0
        while k < len(counts) and self.is_becoming_known(state):
            states[k] = state
            if is_compared[k]:
                state = self._compared_once(
                    state, self.gain, products[k, fast[k]], squares[k, fast[k]], ridge[k, fast[k]]
                )
            k += 1
        states[k:] = self._compared_often(state, is_compared[k:], fast[k:], products[k:], squares[k:], ridge[k:])
        return states, first_end(alone)

    def _compared_once(self, state: _State, gain: float, products: Array, squares: Array, ridge: Array) -> _State:
        """After an interval in which fans were compared; products, squares, ridge: of these."""
        value = self._moved(state, gain, products, squares, ridge)
        if not self.is_becoming_known(state):
            return state._replace(value=value, compared=value)
        begun, known = float(self._begun[0]), float(self._begun_information[0])
        least = max(known + MORE_INFORMATION, LEAST_INFORMATION)
        weight = max(_information(squares, ridge) - least, 0.0)
        informed = state.informed + weight
        commissioned = state.commissioned + weight / (1.0 + informed) * (value - state.commissioned)
        reach = self.limit * (1.0 - known)
        return _State(
            value, value, _between(commissioned, begun - reach, begun + reach), informed, state.searched + 1.0
        )

    def _moved(self, state: _State, gain: float, products: Array, squares: Array, ridge: Array) -> float:
        """The value, moved towards the offsets in the middle."""
        offsets = np.sort(_drawn(products, ridge, state.commissioned) / (squares + ridge))
        middle = (len(offsets) - 1) // 2
        nearest = _between(state.value, float(offsets[middle]), float(offsets[-1 - middle]))
        value = state.value + gain * (nearest - state.value)
        return _between(value, state.commissioned - self.limit, state.commissioned + self.limit)

    def _compared_often(
        self, state: _State, is_compared: Array, fast: Array, products: Array, squares: Array, ridge: Array
    ) -> Array:
        """(intervals, 5) the state in each interval, once it is known what was shared at the commissioning."""
        low, high = (of.tolist() for of in middle_offsets(fast, products, squares, ridge, state.commissioned))
        least, most = state.commissioned - self.limit, state.commissioned + self.limit
        states, value, compared = np.tile(state, (len(is_compared), 1)), state.value, state.compared
        for k, compares in enumerate(is_compared.tolist()):
            states[k, :2] = value, compared
            if compares:
                value += self.gain * (_between(value, low[k], high[k]) - value)
                value = compared = _between(value, least, most)
        return states

    def take(self, of: SharedOverIntervals) -> None:
        """Go on in the last of some intervals."""
        self._set(_State(*of.states[-1]))
        self.products[:], self.squares[:], self.counts[:] = of.products[-1], of.squares[-1], of.counts[-1]

    def end_interval(self, samples: int, commissioned: Array, learns: Array, moving: Array, *, at_first: bool) -> Array:
        """End the present interval of so many samples. at_first: no fan has a baseline yet, and offsets are residuals.

        commissioned: (fans,) which fans have a baseline to be measured against. learns: (fans,) whether a fan's
        baseline may learn from the interval. moving: (fans,) whether the fan moved.

        Returns (fans,) which fan turned alone, so that its baseline is to learn nothing.
        """
        known = (self.counts >= MIN_VALID_SHARE * samples) & (self.squares > 0) & ~moving
        is_compared = known.sum() >= LEAST_FANS
        alone = known & (not is_compared) & (commissioned.sum() >= LEAST_FANS)
        fast = self.fast(known, self.squares, self.counts)
        used, gain = (fast, self.gain) if is_compared else (alone & learns, self._gain_alone)
        if at_first and is_compared:
            self._first += 1
            gain = max(gain, 1.0 / float(self._first[0]))
            information = _information(self.squares[used], self.ridge * FIXED_POINT_ONE * self.counts[used])
            self._begun_information += gain * (information - self._begun_information)
        if used.any():
            products, squares, counts = self.products[used], self.squares[used], self.counts[used]
            ridge = self.ridge * FIXED_POINT_ONE * counts
            if is_compared:
                self._set(self._compared_once(self.now, gain, products, squares, ridge))
            else:
                compared = float(self.compared[0])
                reach = self._reach_sigmas / float(np.sqrt(squares / (counts * FIXED_POINT_ONE))[0])
                value = self._moved(self.now, gain, products, squares, ridge)
                self.value[:] = _between(value, compared - reach, compared + reach)
        self.products[:] = self.squares[:] = self.counts[:] = 0
        return alone

    def is_becoming_known(self, state: _State) -> bool:
        """Whether it is still being found what fans shared when they were commissioned."""
        if self.is_known or self._begun_information[0] >= WELL_KNOWN:
            return False
        return state.informed < ENOUGH_INFORMATION and state.searched < self._most_searched

    @property
    def now(self) -> _State:
        """The present state."""
        return _State(*(float(column[0]) for column in self._columns_of_state))

    def _set(self, state: _State) -> None:
        for column, value in zip(self._columns_of_state, state, strict=True):
            column[:] = value

    @property
    def _columns_of_state(self) -> tuple[Array, ...]:
        return self.value, self.compared, self.commissioned, self._informed, self._searched

    def begin_from_here(self) -> None:
        """The first fan has its baseline, found without what is shared now."""
        self.commissioned[:] = self._begun[:] = self.value
        self._informed[:] = self._searched[:] = 0.0
        self._first[:] = 0

    def restart(self, fans: Array) -> None:
        """Commission some fans again, (fans,) of bool.

        The value is kept, even if these are all fans of the tray. It is a share of the speed. If it were left in the
        residuals, new baselines would learn it as an offset, which is wrong at all other speeds.
        """
        self.products[fans] = self.squares[fans] = self.counts[fans] = 0
        if not fans.all():
            return
        self.commissioned[:] = self.compared[:] = self.value
        self._begun[:] = self.value
        self._first[:] = 0
        self._informed[:] = self._searched[:] = self._begun_information[:] = 0.0

    def fast(self, known: Array, squares: Array, counts: Array) -> Array:
        """(..., fans) those of the known ones that are not much slower than the second fastest of them."""
        mean_square = np.where(known, squares / np.maximum(counts, 1), 0.0)
        second = np.partition(mean_square, -LEAST_FANS, axis=-1)[..., -LEAST_FANS, np.newaxis]
        return known & (mean_square >= MIN_RELATIVE_SPEED**2 * second)

    def columns(self) -> dict[str, Array]:
        """See ColumnState."""
        return {
            "value": self.value,
            "compared": self.compared,
            "commissioned": self.commissioned,
            "first": self._first,
            "informed": self._informed,
            "searched": self._searched,
            "begun": self._begun,
            "begun_information": self._begun_information,
            "products": self.products,
            "squares": self.squares,
            "counts": self.counts,
        }


def sums(offset: Array, speed_sigmas: Array, valid: Array, intervals: Intervals) -> tuple[Array, Array, Array]:
    """(intervals, fans) of samples (n, fans): of the offset times the speed, of its square, and of the valid ones."""
    known = np.where(valid, offset, 0.0).clip(-LARGEST_SIGMAS, LARGEST_SIGMAS)
    speed = np.where(valid, speed_sigmas, 0.0)
    values = np.array((known * speed, speed * speed)).swapaxes(0, 1)
    products, squares = intervals.sums(np.rint(values * FIXED_POINT_ONE).astype(np.int64)).swapaxes(0, 1)
    return products, squares, intervals.sums(valid.astype(np.int64))


def middle_offsets(
    fast: Array, products: Array, squares: Array, ridge: Array, commissioned: Array | float
) -> tuple[Array, Array]:
    """(rows,) the two offsets in the middle of those that are fast, both the same of an odd number. All (rows, fans);
    commissioned: (rows, 1), or one for all.
    """
    number = fast.sum(axis=1)
    divisor = np.where(fast, squares + ridge, 1.0)
    offsets = np.sort(np.where(fast, _drawn(products, ridge, commissioned) / divisor, np.inf), axis=1)
    each, last = np.arange(len(number)), np.maximum(number - 1, 0)
    return offsets[each, last // 2], offsets[each, last - last // 2]


def _drawn(products: Array, ridge: Array, commissioned: Array | float) -> Array:
    """The products, such that the ridge draws towards the value of the commissioning."""
    return products + commissioned * ridge


def _information(squares: Array, ridge: Array) -> float:
    """0 to 1: how much of a share of the speed is known from the second fastest of some fans, against the ridge."""
    return float(np.sort(squares / (squares + ridge))[-LEAST_FANS])


def _between(value: float, low: float, high: float) -> float:
    return min(max(value, low), high)
