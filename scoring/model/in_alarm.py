"""Evidence for each cause of an alarm, from its onset on, for as long as it lasts.

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
from scipy.special import expit

from fantwin.schemas.messages import Array
from fantwin.scoring.diagnosis.ranked_causes import PossibleCause
from fantwin.scoring.model.faults import BEFORE_GROWTH, GROWS_S, UNSTEADY, forces
from fantwin.scoring.model.healthy import HealthyFans
from fantwin.scoring.model.onsets import Evidence, Hypotheses, Sums
from fantwin.scoring.model.operation import Fans, Inputs
from fantwin.scoring.model.saved import part, within

ENDS_S = (15.0, 30.0, 60.0, 120.0, 240.0, 480.0, np.inf)
"""times after its onset at which a fault may stop growing, equally probable"""
FIRST = np.arange(1)
FAR = 16.0
"""cap on the square of a distance, in standard deviations, so that one wrong reading does not decide"""
RECENT_S, STEADY = 5.0, 1.5
"""time constant over which the scatter of a fan is averaged, and largest mean square of a steady one"""
HOPELESS, MOST = 12.0, 24
"""log odds against an onset from which it is dropped; and largest number of onsets"""


class FanInAlarm:
    """Fan with an alarm."""

    def __init__(self, fan: int, fans: Fans, model: HealthyFans, evidence: Evidence, hypotheses: Hypotheses) -> None:
        """Begin with the bin that raised the alarm; model: as it was before the alarm."""
        self._fans, self._model, self._hypotheses = fans.of(fan), model.of(fan), hypotheses.of(fan)
        onsets = np.flatnonzero(np.isfinite(evidence.log_terms(fan)).any(axis=1))
        ages_s = evidence.age_s[onsets]
        ends_s = np.array(ENDS_S)
        which, end = np.nonzero(ends_s[np.newaxis, :] > ages_s[:, np.newaxis])
        self._ends_s, self._ages_s = ends_s[end], ages_s[which]
        self._then_rad_s = evidence.then_rad_s[[fan]][:, onsets[which]]
        self._log_weight = np.log(evidence.weight[onsets] / np.bincount(which, minlength=len(onsets)))[which]
        self._sums = evidence.sums.of(fan, onsets[which], self._hypotheses.columns)
        self._has_changed = evidence.has_changed[[fan]][:, onsets[which]]
        self._varies = np.zeros((2, 2))
        """squares of distances, in standard deviations, and their number: from a healthy fan since the alarm, and from
        one with its fault lately"""
        self._terms = self._log_terms()
        self._drop_hopeless()

    @property
    def age_s(self) -> float:
        """Age of the most probable onset."""
        return float(self._ages_s[self._terms.max(axis=1).argmax()])

    def take(self, now: Inputs, bin_s: float, square: float) -> None:
        """Add the reading of a bin. now: of this fan; square: of its distance, in standard deviations, from the reading
        expected with the fault of the alarm."""
        self._ages_s = self._ages_s + bin_s
        self._has_changed |= now.changes[:, np.newaxis]
        self._model.predict(now)
        found = self._model.innovation(now)
        gain = found.with_states * ((now.readings > 0) / found.variance)[:, np.newaxis]
        pushes = forces(self._fans, now, self._grown_s, self._then_rad_s, self._hypotheses.columns)
        self._sums.add(pushes, self._model, found, gain, found.distance_rad_s)
        self._model.update(found, gain, found.distance_rad_s)
        if gain.any():
            self._varies[1] *= math.exp(-bin_s / RECENT_S)
            squares = np.array([found.distance_rad_s[0] ** 2 / found.variance[0], square])
            self._varies += np.stack((squares.clip(max=FAR), np.ones(2)), axis=1)
            self._terms = self._log_terms()
            self._drop_hopeless()

    def rest(self, bins: int, bin_s: float) -> None:
        """Let a gap pass."""
        self._ages_s = self._ages_s + bins * bin_s
        self._model.rest(bins)

    @property
    def probabilities(self) -> Array:
        """Probabilities (onsets, faults) of the posterior, of faults with a signature."""
        weights = np.exp(self._terms - self._terms.max())
        return np.asarray(weights / weights.sum())

    @property
    def unsteady(self) -> float:
        """Probability that the fault has no signature."""
        _, prior, times = UNSTEADY
        squares, number = self._varies[0]
        logs = 0.5 * np.array([squares * r / (1.0 + r) - number * math.log1p(r) for r in times])
        log_odds = (
            np.logaddexp.reduce(logs) + math.log(prior / len(times)) - np.logaddexp.reduce(self._terms, axis=None)
        )
        return float(expit(log_odds))

    @property
    def varies(self) -> bool:
        """Return whether the fault probably has no signature, and the fan is not steady again."""
        squares, number = self._varies[1]
        return squares > STEADY * number and self.unsteady > 0.5

    def causes(self) -> list[PossibleCause]:
        """All causes, the most probable first."""
        unsteady = self.unsteady
        weights = (1.0 - unsteady) * self.probabilities
        probability: dict[str, float] = {}
        best: dict[str, tuple[float, int, int]] = {}
        for fault, row in enumerate(self._hypotheses.faults):
            onset = int(weights[:, fault].argmax())
            weight = float(weights[:, fault].sum())
            probability[row.cause] = probability.get(row.cause, 0.0) + weight
            best[row.cause] = max(best.get(row.cause, (-1.0, 0, 0)), (weight, onset, fault))
        squares, number = self._varies[0]
        found = [PossibleCause(UNSTEADY[0], unsteady, math.sqrt(squares / max(number, 1.0)), math.nan)]
        for cause, share in probability.items():
            _, onset, fault = best[cause]
            sizes, covariance = self._hypotheses.sizes(self._sums, 0, onset, fault)
            grows = self._hypotheses.faults[fault].columns[0] in BEFORE_GROWTH
            times = float(self._grown_s[onset]) / GROWS_S if grows else 1.0
            found.append(PossibleCause(cause, share, times * float(sizes[0]), times * float(covariance[0, 0]) ** 0.5))
        return sorted(found, key=lambda each: -each.probability)

    def kept(self) -> dict[str, Array]:
        """The state."""
        own = {
            "ends_s": self._ends_s,
            "ages_s": self._ages_s,
            "then_rad_s": self._then_rad_s,
            "log_weight": self._log_weight,
            "has_changed": self._has_changed,
            "varies": self._varies,
        }
        return {**own, **within("model", self._model.arrays()), **within("sums", self._sums.kept(FIRST))}

    def restore(self, stored: Mapping[str, Array]) -> None:
        """Continue from a state.

        Raises:
            KeyError, ValueError: it is not such a state.
        """
        self._ends_s, self._ages_s = stored["ends_s"], stored["ages_s"]
        self._then_rad_s, self._log_weight = stored["then_rad_s"], stored["log_weight"]
        self._has_changed = stored["has_changed"]
        self._varies = stored["varies"]
        self._model.restore(part("model", stored))
        self._sums = Sums(1, len(self._ages_s), self._hypotheses.columns, self._hypotheses.pairs)
        self._sums.restore(FIRST, part("sums", stored))
        self._terms = self._log_terms()

    @property
    def _grown_s(self) -> Array:
        return np.minimum(self._ages_s, self._ends_s)

    def _log_terms(self) -> Array:
        """Log terms (onsets, faults) as in `Hypotheses`, with the weight of the onset."""
        hypotheses = self._hypotheses
        terms = hypotheses.log_bayes_factors(self._sums, self._has_changed)[:, 0] + hypotheses.log_weights()
        return np.asarray((terms + self._log_weight).T)

    def _drop_hopeless(self) -> None:
        if not len(self._terms):  # it goes on from a state
            return
        best = self._terms.max(axis=1)
        kept = np.sort(np.argsort(best)[-MOST:])
        kept = kept[best[kept] > best.max() - HOPELESS]
        if len(kept) == len(best):
            return
        self._ends_s, self._ages_s, self._log_weight = (
            each[kept] for each in (self._ends_s, self._ages_s, self._log_weight)
        )
        self._then_rad_s, self._has_changed = self._then_rad_s[:, kept], self._has_changed[:, kept]
        self._sums, self._terms = self._sums.of(0, kept, self._hypotheses.columns), self._terms[kept]
