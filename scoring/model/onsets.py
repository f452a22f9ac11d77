"""Evidence for a fault: Bayes factors of its onset and cause, added up to a Shiryaev-Roberts statistic.

A fault that began with bin tau changes the innovations by rho times its sizes, where rho, its signature, is what it
adds to the readings less what the filter has absorbed of it since (Willsky and Jones, 1976). With normal priors of the
sizes, each onset and cause has a Bayes factor against a healthy fan from two sums alone,

    A = sum rho rho' / S,   B = sum rho nu / S,   log BF = B' (A + 1/prior)^-1 B / 2 - log|1 + prior A| / 2

R, the sum of all of them by their weights, grows by one per bin on average while a fan is healthy (R_t - t is a
martingale), so the mean time until R > L is at least L bins: the limit is the declared mean time between two false
alarms, in bins.

Onsets of about geometric age stand for all; one that is dropped hands its weight on.

The filter applies one linear map to all onsets and causes. So only the factors of this map are updated in each bin;
every BATCH bins they are multiplied into the parts.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from copy import copy
from itertools import combinations

import numpy as np

from fantwin.schemas.messages import Array
from fantwin.scoring.model.faults import OF_TACHO, STUCK, Fault
from fantwin.scoring.model.healthy import CARRIED, FOLLOWING, STATES, HealthyFans, Innovation
from fantwin.scoring.saved import Saved, alike

ONSETS = 20
LONGEST_S = 900.0
NEVER = -1
BATCH = 8
"""bins"""
FARTHEST, STEPS = 5.0, 256
"""largest argument of the table of log erfc, and its steps within one; erfc gives the chance that a size has the sign
of its fault"""
LOG_ERFC = np.log([math.erfc(at) for at in np.arange(-FARTHEST, FARTHEST + 2.0 / STEPS, 1.0 / STEPS)]).astype(
    np.float32
)
LARGEST_LOG = 80.0
"""largest logarithm that is exponentiated: single precision overflows at 88"""


class Sums(Saved):
    """Sums of the evidence for each onset, of all fans side by side: A and B of the module, and what they follow from.

    The effect of each column on the states, less what the filter has absorbed, is `_factors` times `_parts`. The parts
    are this effect at the last gathering and, for each bin since, the effect on the rotor and rho.
    """

    KEPT = ("on_states", "squares", "crossed", "products")

    def __init__(self, fans: int, onsets: int, columns: int, pairs: Sequence[tuple[int, int]]) -> None:
        """Begin without a reading. pairs: of columns, those that a fault has together."""
        self._rows, self._pairs = np.arange(fans), pairs
        self._parts = np.zeros((fans, CARRIED + 2 * BATCH, onsets * columns), np.float32)
        self._factors = np.zeros((fans, STATES, CARRIED + 2 * BATCH), np.float32)
        self._factors[:, :CARRIED, :CARRIED] = np.eye(CARRIED)
        self._used = CARRIED
        """number of parts so far"""
        is_on_rotor = np.ones((onsets, columns))
        is_on_rotor[:, OF_TACHO] = 0.0
        self._is_on_rotor = is_on_rotor.ravel()
        self.squares = np.zeros((fans, onsets, columns), np.float32)
        """(fans, onsets, columns) the diagonals of A"""
        self.crossed = {pair: np.zeros((fans, onsets), np.float32) for pair in pairs}
        """(fans, onsets) products off the diagonal of A that a fault uses"""
        self.products = np.zeros((fans, onsets, columns), np.float32)

    def of(self, fans: Array, onsets: Array) -> Sums:
        """A copy of some fans, (n,) by number, and of some onsets of each, (n, m) by number."""
        count, columns = onsets.shape[1], self.squares.shape[2]
        copied, rows = Sums(len(fans), count, columns, self._pairs), fans[:, np.newaxis]
        of_onsets = self._parts.reshape(*self._parts.shape[:2], *self.squares.shape[1:])
        copied._parts = of_onsets[rows, :, onsets].swapaxes(1, 2).reshape(copied._parts.shape)
        copied._factors, copied._used = self._factors[fans], self._used
        copied.squares, copied.products = self.squares[rows, onsets], self.products[rows, onsets]
        copied.crossed = {pair: each[rows, onsets] for pair, each in self.crossed.items()}
        return copied

    def joined(self, other: Sums) -> Sums:
        """A copy of these fans and then those of another; those of fewer onsets get empty ones."""
        fans, columns = len(self._rows), self.squares.shape[2]
        found = Sums(fans + len(other._rows), max(self.squares.shape[1], other.squares.shape[1]), columns, self._pairs)
        for each, rows in ((self, slice(fans)), (other, slice(fans, None))):
            each.on_states = each.on_states
            own = slice(each.squares.shape[1] * columns)
            found._parts[rows, :CARRIED, own] = each._parts[:, :CARRIED]
            onsets = slice(each.squares.shape[1])
            found.squares[rows, onsets], found.products[rows, onsets] = each.squares, each.products
            for pair, crossed in found.crossed.items():
                crossed[rows, onsets] = each.crossed[pair]
        return found

    @property
    def on_states(self) -> Array:
        """Effect (fans, CARRIED, onsets * columns) on the states, less what the filter has absorbed; to set it is to
        gather the parts."""
        found: Array = self._factors[:, :CARRIED, : self._used] @ self._parts[:, : self._used]
        return found

    @on_states.setter
    def on_states(self, gathered: Array) -> None:
        self._parts[:, :CARRIED] = gathered
        self._factors[:, :CARRIED, :CARRIED] = np.eye(CARRIED)
        self._used = CARRIED

    def _of(self, onset: int) -> slice:
        """The place of an onset among the parts."""
        columns = self.squares.shape[2]
        return slice(onset * columns, (onset + 1) * columns)

    def taken(self, fan: int, onset: int) -> Array:
        """Effect of each column on the states, less what the filter has absorbed, (columns, STATES)."""
        found: Array = (self._factors[fan, :, : self._used] @ self._parts[fan, : self._used, self._of(onset)]).T
        return found

    def begin(self, onset: int) -> None:
        """Begin an onset again."""
        self._parts[:, : self._used, self._of(onset)] = 0.0
        self.squares[:, onset] = self.products[:, onset] = 0.0
        for each in self.crossed.values():
            each[:, onset] = 0.0

    def add(self, forces: Array, model: HealthyFans, found: Innovation, gain: Array, distance_rad_s: Array) -> None:
        """Add the readings of a bin. forces: (fans, onsets, columns); gain: of the model, 0 where a reading does not
        count; distance_rad_s: (fans,), clipped."""
        if self._used == self._parts.shape[1]:
            self.on_states = self.on_states
        done, read, self._used = self._used, self._used + 1, self._used + 2
        parts, factors = self._parts[:, : self._used], self._factors[:, :, : self._used]
        both = forces.reshape(len(forces), -1)
        np.multiply(both, self._is_on_rotor, out=parts[:, done])
        np.subtract(both, parts[:, done], out=parts[:, read])
        model.carry(factors[:, :, :done])
        factors[:, :, done:] = 0.0
        factors[:, FOLLOWING, done] = model.follows
        deviation = np.sqrt(found.variance)
        weight = (gain.any(axis=1) / deviation).astype(np.float32)
        reads = factors[self._rows, found.shown]
        reads[:, read] = 1.0
        rho = (reads * weight[:, np.newaxis])[:, np.newaxis, :] @ parts  # in standard deviations of the innovation
        parts[:, read] = rho[:, 0]
        np.multiply(gain, -deviation[:, np.newaxis], out=factors[:, :, read])
        rho = rho.reshape(self.squares.shape)
        for one, other in self._pairs:
            self.crossed[one, other] += rho[:, :, one] * rho[:, :, other]
        self.products += rho * (weight * distance_rad_s).astype(np.float32)[:, np.newaxis, np.newaxis]
        self.squares += np.square(rho, out=rho)


def log_erfc(values: Array) -> Array:
    """Logarithms of the complementary error function, to 1e-5 up to FARTHEST and roughly beyond it. Twice as fast as
    SciPy's, in which most of the time would be spent."""
    place = (np.fmax(np.fmin(values, FARTHEST), -FARTHEST) + FARTHEST) * STEPS  # what is no number becomes one
    before = place.astype(np.int32)
    place -= before
    below = LOG_ERFC.take(before)
    found: Array = below + place * (LOG_ERFC.take(before + 1) - below)
    if np.fmax.reduce(values, axis=None, initial=0.0) > FARTHEST:
        beyond = np.fmax(values, FARTHEST)
        found -= (beyond - FARTHEST) * (beyond + FARTHEST)  # erfc falls as exp(-x^2)
    return found


class Hypotheses:
    """Faults with the prior sizes of their columns."""

    def __init__(self, faults: Sequence[Fault], has_own_drive: Array) -> None:
        """Take the rows of a table. has_own_drive: (fans,)."""
        kinds = np.array([not has_own_drive.all(), has_own_drive.any()])
        weights = np.array([(fault.weight, fault.of_own_drive) for fault in faults])
        weights = weights / weights.sum(axis=0) * kinds
        may_be = [(fault, weight) for fault, weight in zip(faults, weights, strict=True) if weight.any()]
        may_be.sort(key=lambda one: one[0].sign == 0)
        self.faults = [fault for fault, _ in may_be]
        """those that one of the fans may have; those of a known sign come first"""
        self._weights = np.array([weight for _, weight in may_be])
        """(faults, 2) weights for a fan whose command is a torque, and for one with a drive of its own"""
        self._has_own_drive = has_own_drive
        self.columns = 1 + max(max(fault.columns) for fault in self.faults)
        self.pairs = sorted({pair for fault in self.faults for pair in combinations(fault.columns, 2)})
        self._first = np.zeros((len(self.faults), self.columns), np.float32)
        """(faults, columns) prior standard deviation of the first size"""
        for row, fault in enumerate(self.faults):
            self._first[row, fault.columns[0]] = fault.std[0]
        signs = np.array([fault.sign for fault in self.faults if fault.sign])
        self._against = (-math.sqrt(0.5) * signs).astype(np.float32)
        self.stuck_rows = [row for row, fault in enumerate(self.faults) if STUCK in fault.columns]
        self._means = [(row, fault.mean) for row, fault in enumerate(self.faults) if fault.mean]

    def of(self, fans: Array) -> Hypotheses:
        """Hypotheses of some fans, (n,) by number, with the rows of all of their tray."""
        found = copy(self)
        found._has_own_drive = self._has_own_drive[fans]
        return found

    def log_weights(self) -> Array:
        """Logarithms of the prior weights, (faults, fans)."""
        with np.errstate(divide="ignore"):
            return np.log(self._weights)[:, self._has_own_drive.astype(np.int64)]

    def weighed(self, bayes_factors: Array) -> Array:
        """Mean over the faults of Bayes factors (faults, fans, onsets), (fans, onsets)."""
        of_kinds = self._weights.T @ bayes_factors.reshape(len(self.faults), -1)
        of_torque, of_own = of_kinds.reshape(2, *bayes_factors.shape[1:])
        return np.where(self._has_own_drive[:, np.newaxis], of_own, of_torque)

    def log_bayes_factors(self, sums: Sums, has_changed: Array) -> Array:
        """Log Bayes factors (faults, fans, onsets), by elimination of one size after the other; the first comes last,
        for its sign.

        has_changed: (fans, onsets) true where the reading has changed since: then its tacho is not stuck.
        """
        shape = (len(self.faults), *sums.squares.shape[:2])
        products = (self._first @ sums.products.reshape(-1, self.columns).T).reshape(shape)
        pivots = (np.square(self._first) @ sums.squares.reshape(-1, self.columns).T).reshape(shape)
        found = np.zeros(shape, np.float32)
        for row, mean in self._means:
            first = self.faults[row].columns[0]
            found[row] += mean * (sums.products[:, :, first] - 0.5 * mean * sums.squares[:, :, first])
            products[row] -= mean / self.faults[row].std[0] * pivots[row]
        pivots += 1.0
        for row, fault in enumerate(self.faults):
            if len(fault.columns) > 1:
                found[row], pivots[row], products[row] = _without_others(fault, sums)
        of_sign = slice(len(self._against))
        sized = products[of_sign] / np.sqrt(pivots[of_sign])
        sized *= self._against[:, np.newaxis, np.newaxis]
        found[of_sign] += log_erfc(sized)
        products *= products
        products /= pivots
        products -= np.log(pivots, out=pivots)
        products *= 0.5
        found += products
        for row in self.stuck_rows:
            found[row][has_changed] = -np.inf
        return found

    def sizes(self, sums: Sums, fan: int, onset: int, fault: int) -> tuple[Array, Array]:
        """Mean (columns,) and covariance of the sizes of a fault that began with an onset."""
        columns = np.array(self.faults[fault].columns)
        prior = np.diag(1.0 / np.square(self.faults[fault].std))
        covariance = np.linalg.inv(_squares(self.faults[fault], sums)[:, :, fan, onset] + prior)
        return covariance @ (sums.products[fan, onset, columns] + prior[0] * self.faults[fault].mean), covariance


def _squares(fault: Fault, sums: Sums) -> Array:
    """Products (columns, columns, fans, onsets) of A that a fault uses."""
    columns = fault.columns
    found = np.empty((len(columns), len(columns), *sums.squares.shape[:2]), np.float32)
    for one, column in enumerate(columns):
        found[one, one] = sums.squares[:, :, column]
        for other in range(one):
            found[one, other] = found[other, one] = sums.crossed[columns[other], column]
    return found


def _without_others(fault: Fault, sums: Sums) -> tuple[Array, Array, Array]:
    """Evidence (fans, onsets) of all sizes of a fault but the first, and what they leave of its pivot and product."""
    std = np.array(fault.std, np.float32)[:, np.newaxis, np.newaxis]
    squares, products = _squares(fault, sums), np.stack([sums.products[:, :, column] for column in fault.columns])
    found = fault.mean * (products[0] - 0.5 * fault.mean * squares[0, 0])
    products -= fault.mean * squares[0]
    products *= std
    squares *= std[:, np.newaxis] * std
    for one in range(len(std)):
        squares[one, one] += 1.0
    for one in range(len(std) - 1, 0, -1):
        pivot, product = np.maximum(squares[one, one], 1.0), products[one]  # rounded, it may be less
        found += 0.5 * (product**2 / pivot - np.log(pivot))
        ratio = squares[one, :one] / pivot
        products[:one] -= ratio * product
        squares[:one, :one] -= ratio[:, np.newaxis] * squares[one, :one]
    return found, np.maximum(squares[0, 0], 1.0), products[0]


class Evidence(Saved):
    """Onsets and the evidence for each, of all fans side by side."""

    KEPT = ("number", "began", "weight", "since", "then_rad_s", "has_changed", "sums")
    OF_TRAY = KEPT[:3]

    def __init__(self, fans: int, hypotheses: Hypotheses, bin_s: float) -> None:
        """Begin without a reading."""
        self._bin_s, self._hypotheses = bin_s, hypotheses
        self.sums = Sums(fans, ONSETS, hypotheses.columns, hypotheses.pairs)
        self.began = np.full(ONSETS, NEVER)
        """(ONSETS,) bins at which they began, in no order; NEVER: not yet"""
        self._order = list(range(ONSETS))
        """places of the onsets, the oldest first"""
        self.weight = np.ones(ONSETS)
        self.then_rad_s = np.zeros((fans, ONSETS))
        """(fans, ONSETS) speed at which they began"""
        self.has_changed = np.zeros((fans, ONSETS), np.bool_)
        """(fans, ONSETS) true where the reading has changed since the bin of the onset"""
        self.since = np.full(fans, NEVER)
        """(fans,) bin after which onsets count"""
        self.large = np.zeros(fans, np.bool_)
        """(fans,) true where the evidence is large enough for a snapshot"""
        self._log_bayes_factors = np.zeros((len(hypotheses.faults), fans, ONSETS), np.float32)
        self.number = 0

    @property
    def age_s(self) -> Array:
        """Age of each onset at the end of the present bin, (ONSETS,)."""
        return (self.number - self.began + 1) * self._bin_s

    def begin(self, speed_rad_s: Array) -> None:
        """Begin a bin with a new onset, in the place of an older one. speed_rad_s: (fans,) before it."""
        self.number += 1
        slot = self._place()
        self.began[slot], self.weight[slot] = self.number, 1.0
        self.then_rad_s[:, slot], self.has_changed[:, slot] = speed_rad_s, False
        self.sums.begin(slot)

    def show(self, changes: Array) -> None:
        """Note where the tacho has shown another reading within the bin, (fans,)."""
        self.has_changed |= changes[:, np.newaxis] & (self.began < self.number)

    def _place(self) -> int:
        """Return the place of a new onset: an unused one, that of the oldest if it is too old, or the one without which
        the ages are nearest to geometric."""
        order = self._order
        began = self.began[order]
        drop = 0
        if began[0] != NEVER and self.number - began[0] < LONGEST_S / self._bin_s:
            drop = 1 + int(np.argmin((began[2:] - began[:-2]) / (self.number - began[1:-1])))
            self.weight[order[drop - 1]] += self.weight[order[drop]]
        order.append(order.pop(drop))
        return order[-1]

    def add(self, forces: Array, model: HealthyFans, found: Innovation, gain: Array, distance_rad_s: Array) -> None:
        """Add the readings of a bin, as in `Sums.add`."""
        self.sums.add(forces, model, found, gain, distance_rad_s)
        self._log_bayes_factors = self._hypotheses.log_bayes_factors(self.sums, self.has_changed)

    @property
    def _counts(self) -> Array:
        """Return where onsets count, (fans, ONSETS)."""
        return self.began > self.since[:, np.newaxis]

    def log_terms(self, fan: int) -> Array:
        """Log of Bayes factor and weight of a fan's onsets and faults, (ONSETS, faults)."""
        terms = self._log_bayes_factors[:, fan] + self._hypotheses.log_weights()[:, fan, np.newaxis]
        found: Array = np.where(self._counts[fan], terms + np.log(self.weight), -np.inf).T
        return found

    def forget(self, fan: int) -> None:
        """Begin again for a fan."""
        self.since[fan] = self.number

    def arrays(self) -> dict[str, Array]:
        """See Saved; of the fans `large`, whose evidence a snapshot keeps."""
        return {
            name: array if name in self.OF_TRAY else array[self.large] for name, array in super().arrays().items()
        } | {"large": self.large}

    def restore(self, stored: Mapping[str, Array]) -> None:
        """See Saved; the evidence of the fans that are not large begins again."""
        whole, large = super().arrays(), alike(self.large, stored, "large")
        whole["since"][:] = stored["number"]
        for name, array in whole.items():
            if name in self.OF_TRAY:
                whole[name] = stored[name]
            else:
                array[large] = alike(array[large], stored, name)
        super().restore(whole)
        self._order = np.argsort(self.began, kind="stable").tolist()

    def log_statistic(self) -> Array:
        """Log R, (fans,)."""
        logs, counts, beyond = self._log_bayes_factors, self._counts, 0.0
        if logs.max() > LARGEST_LOG:
            logs = np.where(counts, logs, -np.inf)
            beyond = np.maximum(logs.max(axis=(0, 2)) - LARGEST_LOG, 0.0)
            logs = logs - beyond[:, np.newaxis]
        terms = self._hypotheses.weighed(np.exp(logs))
        terms *= counts * self.weight
        with np.errstate(divide="ignore"):
            return np.log(terms.sum(axis=1)) + beyond
