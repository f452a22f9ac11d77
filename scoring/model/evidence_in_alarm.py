"""Evidence for each cause of the alarms of a tray, from its onset on, for as long as it lasts.

A copy of the model of a healthy fan goes on as though nothing were wrong, and with it the sums of each onset that was
possible when the alarm was raised. So what a fan does long afterwards still counts. A growing fault may stop growing:
each onset appears once for each time after which it may have stopped.

A fault may also have no signature: then the readings scatter more than those of a healthy fan, with 1 + r times their
variance S. With z = nu / sqrt(S), log BF = sum (z^2 r / (1 + r) - log(1 + r)) / 2.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from fantwin.schemas.messages import Array
from fantwin.scoring.diagnosis.ranked_causes import PossibleCause
from fantwin.scoring.model.faults import BEFORE_GROWTH, GROWS_S, UNSTEADY, forces
from fantwin.scoring.model.healthy import HealthyFans
from fantwin.scoring.model.onsets import Evidence, Hypotheses, Sums
from fantwin.scoring.model.operation import Inputs
from fantwin.scoring.saved import Saved

ENDS_S = np.array([15.0, 30.0, 60.0, 120.0, 240.0, 480.0, np.inf])
"""times after its onset at which a fault may stop growing, equally probable"""
FAR = 16.0
"""cap on the square of a distance, in standard deviations, so that one wrong reading does not decide"""
RECENT_S, STEADY = 5.0, 1.5
"""time constant over which the scatter of a fan is averaged, and largest mean square of a steady one"""
HOPELESS, MOST = 12.0, 24
"""log odds against an onset from which it is dropped; and largest number of onsets"""
OF_ONSETS = {"ends_s": np.inf, "ages_s": 0.0, "then_rad_s": 0.0, "log_weight": -np.inf, "has_changed": False}
"""what is known of each onset, and its value where there is none"""


class FansInAlarm(Saved):
    """Fans of a tray that have an alarm, side by side: n of them, with m onsets each."""

    KEPT = ("fans", "_onsets", "_varies", "_model", "_sums")

    def __init__(self, model: HealthyFans, hypotheses: Hypotheses) -> None:
        """Begin without one. model, hypotheses: of the tray."""
        self._of_tray, self._of_all = model, hypotheses
        self._begin(np.zeros(0, np.int64), 0)

    def _begin(self, fans: Array, onsets: int) -> None:
        """Begin with these fans and a number of onsets, of which nothing is known."""
        self.fans = fans
        """(n,) their numbers, in the order of their alarms"""
        self._onsets = {name: np.full((len(fans), onsets), value) for name, value in OF_ONSETS.items()}
        """(n, m) each"""
        self._varies = np.zeros((2, 2, len(fans)))
        """(2, 2, n) from a healthy fan since the alarm, and from one with its fault lately: squares of distances, in
        standard deviations, and their number"""
        self._model, self._hypotheses = self._of_tray.of(fans), self._of_all.of(fans)
        self._sums = Sums(len(fans), onsets, self._of_all.columns, self._of_all.pairs)
        self._terms = np.zeros((len(fans), onsets, len(self._of_all.faults)))
        """(n, m, faults) log terms as in `Hypotheses`, with the weight of the onset"""

    def add(self, fan: int, evidence: Evidence) -> None:
        """Add the fan of an alarm that the present bin raises, while the model of the tray is as it was before."""
        onsets = np.flatnonzero(np.isfinite(evidence.log_terms(fan)).any(axis=1))
        which, end = np.nonzero(evidence.age_s[onsets, np.newaxis] < ENDS_S)
        places = onsets[which]
        weight = evidence.weight[onsets] / np.bincount(which, minlength=len(onsets))
        own = FansInAlarm(self._of_tray, self._of_all)
        own._begin(np.array([fan]), len(places))
        own._onsets = {
            "ends_s": ENDS_S[np.newaxis, end],
            "ages_s": evidence.age_s[np.newaxis, places],
            "then_rad_s": evidence.then_rad_s[[fan]][:, places],
            "log_weight": np.log(weight)[np.newaxis, which],
            "has_changed": evidence.has_changed[[fan]][:, places],
        }
        own._sums = evidence.sums.of(own.fans, places[np.newaxis])
        own._weigh()
        self._join(own)

    def drop(self, fan: int) -> None:
        """Forget a fan that has no alarm any more; nothing happens if it is none of them."""
        if fan in self.fans:
            self._keep(np.flatnonzero(self.fans != fan))

    def clear(self) -> None:
        """Forget all."""
        self._keep(np.zeros(0, np.int64))

    def take(self, now: Inputs, bin_s: float, squares: Array) -> None:
        """Add the readings of a bin. now: of the tray; squares: (n,) of their distances, in standard deviations, from
        the readings expected with the fault of each alarm."""
        now, onsets, model = now.of(self.fans), self._onsets, self._model
        onsets["ages_s"] += bin_s
        onsets["has_changed"] |= now.changes[:, np.newaxis]
        model.predict(now)
        found, counts = model.innovation(now), now.readings > 0
        gain = found.with_states * (counts / found.variance)[:, np.newaxis]
        pushes = forces(model.fans, now, self._grown_s, onsets["then_rad_s"], self._hypotheses.columns)
        self._sums.add(pushes, model, found, gain, found.distance_rad_s)
        model.update(found, gain, found.distance_rad_s)
        if counts.any():
            self._varies[1] *= np.where(counts, math.exp(-bin_s / RECENT_S), 1.0)
            both = np.stack((np.square(found.distance_rad_s) / found.variance, squares)).clip(max=FAR)
            self._varies += np.stack((both, np.ones_like(both)), axis=1) * counts
        self._weigh()  # a reading may have changed that does not count

    def rest(self, bins: int, bin_s: float) -> None:
        """Let a gap pass."""
        self._onsets["ages_s"] += bins * bin_s
        self._model.rest(bins)

    def age_s(self, fan: int) -> float:
        """Age of the most probable onset of a fan."""
        row = self._row(fan)
        return float(self._onsets["ages_s"][row, self._terms[row].max(axis=1).argmax()])

    @property
    def probabilities(self) -> Array:
        """Probabilities of the faults with a signature, (n, faults)."""
        return _posterior(self._terms).sum(axis=1)

    @property
    def varies(self) -> Array:
        """Return where the fault probably has no signature, and the fan is not steady again, (n,)."""
        squares, number = self._varies[1]
        return np.asarray((squares > STEADY * number) & (_unsteady(self._varies[0], self._terms) > 0.5))

    def causes(self, fan: int) -> list[PossibleCause]:
        """All causes of the alarm of a fan, the most probable first; none if it has no alarm."""
        if fan not in self.fans:
            return []
        row = self._row(fan)
        unsteady = float(_unsteady(self._varies[0, :, [row]].T, self._terms[[row]])[0])
        weights = (1.0 - unsteady) * _posterior(self._terms[[row]])[0]
        probability: dict[str, float] = {}
        best: dict[str, tuple[float, int, int]] = {}
        for fault, of_table in enumerate(self._hypotheses.faults):
            onset = int(weights[:, fault].argmax())
            weight = float(weights[:, fault].sum())
            probability[of_table.cause] = probability.get(of_table.cause, 0.0) + weight
            best[of_table.cause] = max(best.get(of_table.cause, (-1.0, 0, 0)), (weight, onset, fault))
        squares, number = self._varies[0, :, row].tolist()
        found = [PossibleCause(UNSTEADY[0], unsteady, math.sqrt(squares / max(number, 1.0)), math.nan)]
        for cause, share in probability.items():
            _, onset, fault = best[cause]
            sizes, covariance = self._hypotheses.sizes(self._sums, row, onset, fault)
            grows = self._hypotheses.faults[fault].columns[0] in BEFORE_GROWTH
            times = float(self._grown_s[row, onset]) / GROWS_S if grows else 1.0
            found.append(PossibleCause(cause, share, times * float(sizes[0]), times * float(covariance[0, 0]) ** 0.5))
        return sorted(found, key=lambda each: -each.probability)

    def arrays(self) -> dict[str, Array]:
        """See Saved; nothing without an alarm."""
        return super().arrays() if len(self.fans) else {}

    def restore(self, stored: Mapping[str, Array]) -> None:
        """See Saved."""
        self.clear()
        if stored:
            fans, onsets = stored["fans"], stored["_onsets.ages_s"]
            if not np.isin(fans, np.arange(len(self._of_tray.mean))).all():
                raise ValueError("an alarm of a fan that does not exist")
            self._begin(fans, onsets.shape[-1] if onsets.size else 0)
            super().restore(stored)
            self._terms = self._log_terms()

    @property
    def _grown_s(self) -> Array:
        return np.minimum(self._onsets["ages_s"], self._onsets["ends_s"])

    def _row(self, fan: int) -> int:
        return self.fans.tolist().index(fan)

    def _log_terms(self) -> Array:
        """See `_terms`."""
        factors = self._hypotheses.log_bayes_factors(self._sums, self._onsets["has_changed"])
        terms = factors + self._hypotheses.log_weights()[:, :, np.newaxis] + self._onsets["log_weight"]
        return np.asarray(terms.transpose(1, 2, 0))

    def _weigh(self) -> None:
        """Set the terms, and drop the onsets that are hopeless."""
        self._terms = self._log_terms()
        best = self._terms.max(axis=2)
        order = np.argsort(-best, axis=1, kind="stable")
        is_hopeless = best <= best.max(axis=1, keepdims=True) - HOPELESS
        self._onsets["log_weight"][is_hopeless] = self._terms[is_hopeless] = -np.inf
        most = min(int((~is_hopeless).sum(axis=1).max()), MOST)
        if most < best.shape[1]:
            order, rows = np.sort(order[:, :most], axis=1), np.arange(len(best))[:, np.newaxis]
            self._onsets = {name: each[rows, order] for name, each in self._onsets.items()}
            self._terms = self._terms[rows, order]
            self._sums = self._sums.of(rows[:, 0], order)

    def _join(self, other: FansInAlarm) -> None:
        """Put the fans of another behind these."""
        count, onsets = len(self.fans), max(self._terms.shape[1], other._terms.shape[1])
        for name, empty in OF_ONSETS.items():
            both = np.full((count + len(other.fans), onsets), empty)
            for each, rows in ((self, slice(count)), (other, slice(count, None))):
                both[rows, : each._terms.shape[1]] = each._onsets[name]
            self._onsets[name] = both
        self.fans = np.concatenate((self.fans, other.fans))
        self._varies = np.concatenate((self._varies, other._varies), axis=2)
        self._sums = self._sums.joined(other._sums)
        model = self._of_tray.of(self.fans)
        model.continue_as(self._model)
        self._model, self._hypotheses = model, self._of_all.of(self.fans)
        self._terms = self._log_terms()

    def _keep(self, rows: Array) -> None:
        """Keep some of the fans, (n,) by their place."""
        self.fans, self._varies = self.fans[rows], self._varies[:, :, rows]
        self._onsets = {name: each[rows] for name, each in self._onsets.items()}
        onsets = np.tile(np.arange(self._terms.shape[1]), (len(rows), 1))
        self._sums, self._terms = self._sums.of(rows, onsets), self._terms[rows]
        self._model, self._hypotheses = self._model.of(rows), self._of_all.of(self.fans)


def _posterior(terms: Array) -> Array:
    """Probabilities of onsets and faults, from their log terms, (n, m, faults) each."""
    weights = np.exp(terms - terms.max(axis=(1, 2), keepdims=True))
    return np.asarray(weights / weights.sum(axis=(1, 2), keepdims=True))


def _unsteady(varies: Array, terms: Array) -> Array:
    """Probability that the fault has no signature, (n,). varies: (2, n) squares and their number; terms: of the others,
    (n, m, faults)."""
    _, prior, times = UNSTEADY
    squares, number = varies
    logs = [0.5 * (squares * r / (1.0 + r) - number * math.log1p(r)) for r in times]
    log_odds = np.logaddexp.reduce(logs) + math.log(prior / len(times))
    return np.exp(-np.logaddexp(0.0, np.logaddexp.reduce(terms, axis=(1, 2)) - log_odds))
