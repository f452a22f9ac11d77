"""Evidence for a fault: Bayes factors of its onset and cause, added up to a Shiryaev-Roberts statistic.

A fault that began with bin tau changes the innovations by rho times its sizes, where rho is what it adds to the
readings less what the filter has taken up of it since (Willsky and Jones, 1976). With normal priors of the sizes, each
onset and cause has a Bayes factor against a healthy fan from two sums alone,

    A = sum rho rho' / S,   B = sum rho nu / S,   log BF = B' (A + 1/prior)^-1 B / 2 - log|1 + prior A| / 2

R, the sum of all of them by their weights, grows by one a bin in the mean while a fan is healthy (R_t - t is a
martingale), so the mean time until R > L is at least L bins: the limit is the declared time itself.

Onsets of about geometric age stand for all; one that is dropped hands its weight on.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.special import log_ndtr

from bench.detection.one_model.faults import COLUMNS, OF_TACHO, Fault
from bench.detection.one_model.healthy import COUNT, COUNT_BEFORE, FOLLOWING, STATES, HealthyFans, Innovation
from schemas.messages import Array

ONSETS = 20
LONGEST_S = 900.0
NEVER = -1


class Sums:
    """What speaks for each onset, of all fans side by side: A and B of the module, and what they follow from."""

    def __init__(self, fans: int, onsets: int) -> None:
        """Begin without a reading."""
        self._fans = np.arange(fans)
        self.taken = np.zeros((fans, onsets, COLUMNS, STATES))
        """(fans, onsets, COLUMNS, STATES): what each column has made of the states less what the filter took up"""
        self.squares = np.zeros((fans, onsets, COLUMNS, COLUMNS))
        self.products = np.zeros((fans, onsets, COLUMNS))

    def of(self, fan: int, onsets: Array) -> Sums:
        """A copy of some onsets of one fan."""
        copied = Sums(1, len(onsets))
        copied.taken[0], copied.squares[0] = self.taken[fan, onsets], self.squares[fan, onsets]
        copied.products[0] = self.products[fan, onsets]
        return copied

    def begin(self, onset: int) -> None:
        """Begin an onset again."""
        self.taken[:, onset] = 0.0
        self.squares[:, onset] = 0.0
        self.products[:, onset] = 0.0

    def add(self, forces: Array, model: HealthyFans, found: Innovation, gain: Array, distance_rad_s: Array) -> None:
        """The readings of a bin. forces: (fans, onsets, COLUMNS); gain: of the model, 0 where a reading does not count;
        distance_rad_s: (fans,) as far as it counts."""
        taken = self.taken
        taken[model.counted, ..., COUNT_BEFORE] = taken[model.counted, ..., COUNT]
        taken *= model.kept[:, np.newaxis, np.newaxis, :]
        on_rotor = forces.copy()
        on_rotor[..., OF_TACHO] = 0.0
        follows = model.follows[:, np.newaxis, np.newaxis, :]
        taken[..., FOLLOWING] = taken @ model.tends.swapaxes(1, 2)[:, np.newaxis] + on_rotor[..., np.newaxis] * follows
        rho = taken[self._fans, :, :, found.shown]
        rho += found.counts_pulses[:, np.newaxis, np.newaxis] * (taken[..., COUNT] - taken[..., COUNT_BEFORE])
        rho[..., OF_TACHO] += forces[..., OF_TACHO]
        taken -= rho[..., np.newaxis] * gain[:, np.newaxis, np.newaxis, :]
        weighed = rho * (gain.any(axis=1) / found.variance)[:, np.newaxis, np.newaxis]
        self.squares += rho[..., :, np.newaxis] * weighed[..., np.newaxis, :]
        self.products += weighed * distance_rad_s[:, np.newaxis, np.newaxis]


class Hypotheses:
    """Faults with the prior sizes of their columns."""

    def __init__(self, faults: Sequence[Fault], has_own_drive: Array) -> None:
        """Take the rows of a table. has_own_drive: (fans,)."""
        self.faults, self._has_own_drive = faults, has_own_drive
        most = max(len(fault.columns) for fault in faults)
        self._columns = np.zeros((len(faults), most), np.int64)
        self._std = np.zeros((len(faults), most))
        for row, fault in enumerate(faults):
            self._columns[row, : len(fault.columns)] = fault.columns
            self._std[row, : len(fault.columns)] = fault.std
        self._mean = np.array([fault.mean for fault in faults])
        self._sign = np.array([fault.sign for fault in faults], np.float64)
        weights = np.array([(fault.weight, fault.of_own_drive) for fault in faults])
        with np.errstate(divide="ignore"):
            self._log_weight = np.log(np.where(has_own_drive[:, np.newaxis], weights[:, 1], weights[:, 0]))

    def of(self, fan: int) -> Hypotheses:
        """Those of one fan."""
        return Hypotheses(self.faults, self._has_own_drive[[fan]])

    def log_terms(self, sums: Sums) -> Array:
        """(fans, onsets, faults) log of Bayes factor and prior weight of a fault."""
        return self._log_bayes_factors(sums) + self._log_weight[:, np.newaxis, :]

    def _log_bayes_factors(self, sums: Sums) -> Array:
        """(fans, onsets, faults), by elimination of one size after the other; the first comes last, for its sign."""
        columns, std = self._columns, self._std
        products = sums.products[:, :, columns]
        squares = sums.squares[:, :, columns[:, :, np.newaxis], columns[:, np.newaxis, :]]
        found = self._mean * (products[..., 0] - 0.5 * self._mean * squares[..., 0, 0])
        products = (products - self._mean[:, np.newaxis] * squares[..., 0]) * std
        squares = squares * (std[:, :, np.newaxis] * std[:, np.newaxis, :])
        most = columns.shape[1]
        squares[..., np.arange(most), np.arange(most)] += 1.0
        for one in range(most - 1, -1, -1):
            pivot, product = squares[..., one, one], products[..., one]
            found += 0.5 * (product**2 / pivot - np.log(pivot))
            if one == 0:
                with_sign = np.log(2.0) + log_ndtr(self._sign * product / np.sqrt(pivot))
                found += np.where(self._sign == 0.0, 0.0, np.maximum(with_sign, -30.0))
            for other in range(one):
                ratio = squares[..., other, one] / pivot
                products[..., other] -= ratio * product
                for third in range(other, one):
                    squares[..., other, third] -= ratio * squares[..., third, one]
                    squares[..., third, other] = squares[..., other, third]
        return found

    def sizes(self, sums: Sums, fan: int, onset: int, fault: int) -> tuple[Array, Array]:
        """Mean (columns,) and covariance of the sizes of a fault that began with an onset."""
        columns = np.array(self.faults[fault].columns)
        prior = np.diag(1.0 / np.square(self.faults[fault].std))
        covariance = np.linalg.inv(sums.squares[fan, onset][np.ix_(columns, columns)] + prior)
        return covariance @ (sums.products[fan, onset, columns] + prior[0] * self.faults[fault].mean), covariance


class Evidence:
    """Onsets and what speaks for each, of all fans side by side."""

    def __init__(self, fans: int, hypotheses: Hypotheses, bin_s: float) -> None:
        """Begin without a reading."""
        self._bin_s, self._hypotheses = bin_s, hypotheses
        self.sums = Sums(fans, ONSETS)
        self.began = np.full(ONSETS, NEVER)
        """(ONSETS,) bins at which they began, in no order; NEVER: not yet"""
        self.weight = np.ones(ONSETS)
        self.then_rad_s = np.zeros((fans, ONSETS))
        """(fans, ONSETS) speed at which they began"""
        self.since = np.full(fans, NEVER)
        """(fans,) only onsets after this bin count"""
        self.log_terms = np.full((fans, ONSETS, len(hypotheses.faults)), -np.inf)
        self.number = 0

    @property
    def age_s(self) -> Array:
        """(ONSETS,) at the end of the present bin."""
        return (self.number - self.began + 1) * self._bin_s

    def begin(self, speed_rad_s: Array) -> None:
        """A new bin: one onset more, in the place of one of the older ones. speed_rad_s: (fans,) before it."""
        self.number += 1
        slot = self._place()
        self.began[slot], self.weight[slot] = self.number, 1.0
        self.then_rad_s[:, slot] = speed_rad_s
        self.sums.begin(slot)

    def _place(self) -> int:
        """An unused one, the oldest if it is too old, or the one without which the ages are nearest to geometric."""
        order = np.argsort(self.began)
        began = self.began[order]
        if began[0] == NEVER or self.number - began[0] >= LONGEST_S / self._bin_s:
            return int(order[0])
        drop = 1 + int(np.argmin((began[2:] - began[:-2]) / (self.number - began[1:-1])))
        self.weight[order[drop - 1]] += self.weight[order[drop]]
        return int(order[drop])

    def add(self, forces: Array, model: HealthyFans, found: Innovation, gain: Array, distance_rad_s: Array) -> None:
        """The readings of a bin, as in `Sums.add`."""
        self.sums.add(forces, model, found, gain, distance_rad_s)
        self.log_terms = self._hypotheses.log_terms(self.sums) + np.log(self.weight)[:, np.newaxis]
        self.log_terms[self.began[np.newaxis, :] <= self.since[:, np.newaxis]] = -np.inf

    def forget(self, fan: int) -> None:
        """Begin again for a fan."""
        self.since[fan] = self.number

    def log_statistic(self) -> Array:
        """(fans,) log R."""
        flat = self.log_terms.reshape(len(self.log_terms), -1)
        found: Array = np.logaddexp.reduce(flat, axis=1)
        return found
