"""What speaks for each cause of an alarm, from its onset on, for as long as it lasts.

The model of a healthy fan goes on as though nothing were wrong, and the sums of each onset that was possible when the
alarm was raised go on with it, so what a fan does long afterwards still counts. What grows may end to grow: each onset
stands once for each time after which it may have ended.
"""

from __future__ import annotations

import numpy as np

from bench.detection.one_model.faults import forces
from bench.detection.one_model.healthy import HealthyFans
from bench.detection.one_model.onsets import Evidence, Hypotheses
from bench.detection.one_model.operation import Fans, Inputs

ENDS_S = (15.0, 30.0, 60.0, 120.0, 240.0, 480.0, np.inf)
"""times after its onset at which a growth may end, equally probable"""


class FanInAlarm:
    """One fan with an alarm."""

    def __init__(self, fan: int, fans: Fans, model: HealthyFans, evidence: Evidence, hypotheses: Hypotheses) -> None:
        """Begin with the bin that raised the alarm; model: which has not heard of the alarm."""
        self._fans, self._model, self._hypotheses = fans.of(fan), model.of(fan), hypotheses.of(fan)
        onsets = np.flatnonzero(np.isfinite(evidence.log_terms[fan]).any(axis=1))
        ages_s = evidence.age_s[onsets]
        ends_s = np.array(ENDS_S)
        which, end = np.nonzero(ends_s[np.newaxis, :] > ages_s[:, np.newaxis])
        self._ends_s, self._age_s = ends_s[end], ages_s[which]
        self._then_rad_s = evidence.then_rad_s[[fan]][:, onsets[which]]
        self._log_weight = np.log(evidence.weight[onsets] / np.bincount(which, minlength=len(onsets)))[which]
        self._sums = evidence.sums.of(fan, onsets[which])
        self.causes = self._posterior()
        """probability of each cause"""

    @property
    def age_s(self) -> float:
        """Of the likeliest onset."""
        return float(self._age_s[self._likeliest])

    def take(self, now: Inputs, bin_s: float, *, counts: bool) -> None:
        """Take the reading of a bin up. now: of this fan; counts: it is none of a tacho gone wrong."""
        self._age_s = self._age_s + bin_s
        self._model.predict(now)
        found = self._model.innovation(now)
        gain = found.with_states * (((now.readings > 0) & counts) / found.variance)[:, np.newaxis]
        ages_s = np.minimum(self._age_s, self._ends_s)
        pushes = forces(self._fans, now, ages_s, self._then_rad_s)
        self._sums.add(pushes, self._model, found, gain, found.distance_rad_s)
        self._model.update(found, gain, found.distance_rad_s)
        if gain.any():
            self.causes = self._posterior()

    def _posterior(self) -> dict[str, float]:
        terms = self._hypotheses.log_terms(self._sums)[0] + self._log_weight[:, np.newaxis]
        self._likeliest = int(terms.max(axis=1).argmax())
        weights = np.exp(terms - terms.max()).sum(axis=0)
        found: dict[str, float] = {}
        for fault, weight in zip(self._hypotheses.faults, weights / weights.sum(), strict=True):
            found[fault.cause] = found.get(fault.cause, 0.0) + float(weight)
        return found
