"""What is probably wrong with a fan: causes with probabilities, and what speaks for each.

The window's balance is compared with each single fault (scoring.diagnosis.hypotheses), the readings with those of a
broken sensor
(scoring.diagnosis.sensor_evidence). Beforehand causes are equally probable, a changed scale of the sensor less, and
so is that
nothing in the balance changed.

Where the motion excites no difference between two faults, both keep half the probability. `cannot_tell` gets the
probability that naming the first cause would be wrong, be it because another is true or because nothing changed. So it
comes first exactly when the best cause is less probable than all the others together.

A stuck sensor says nothing of the motion: its balance is explained as well as by the best of the others. A sensor that
drops out still tells the truth where it speaks: its balance has to be healthy.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scoring.diagnosis.hypotheses import CAUSES, Comparison, Explanation, log_sum
from scoring.diagnosis.regression_window import Array, HealthyBalance, RegressionWindow, Window
from scoring.diagnosis.sensor_evidence import dropout_log_ratio, stuck_log_ratio

CANNOT_TELL, STUCK, DROPOUT = "cannot_tell", "sensor_stuck", "sensor_dropout"
FEWEST_AFTER_S = 0.2
CLEAR = 0.5
STILL = 0.05
"""a speed that moves by less than this share excites nothing"""


@dataclass(frozen=True)
class Evidence:
    """What changed: by how much, with a 95 % interval.

    unit: `relative` (to the healthy value), `command` (in units of it), `share` or `samples`.
    """

    parameter: str
    change: float
    low: float
    high: float
    unit: str


@dataclass(frozen=True)
class RankedCause:
    """One cause. probability: 0 to 1. sentence: the evidence in words."""

    cause: str
    probability: float
    evidence: Evidence | None
    sentence: str


@dataclass(frozen=True)
class Diagnosis:
    """All causes, the most probable first; their probabilities add up to one."""

    suspects: tuple[RankedCause, ...]

    @property
    def first(self) -> RankedCause:
        """The most probable one."""
        return self.suspects[0]


def diagnose(window: Window, healthy: HealthyBalance) -> Diagnosis:
    """Diagnose one fan from its last seconds: some before the onset, and all since.

    Some three seconds of health before the onset are enough; what comes after it decides. It may be asked again
    whenever there is more. Takes milliseconds.
    """
    told = np.isfinite(window.command)  # where not even the command is known the line was silent, not the sensor
    speed, onset = window.speed_rad_s[told], int(np.count_nonzero(told[: window.onset]))
    regression = RegressionWindow(window, healthy)
    stuck, repeats = stuck_log_ratio(speed, onset)
    dropout, missing = dropout_log_ratio(speed, onset)
    judged = len(regression.speeds_after) * window.step_s >= FEWEST_AFTER_S
    if judged:
        comparison = Comparison(regression, healthy)
        nothing = comparison.nothing()
        explanations = [comparison.explain(cause) for cause in CAUSES]
    else:
        nothing, explanations = 0.0, []
    best = max((one.log_evidence for one in explanations), default=0.0)
    names = [one.cause.name for one in explanations] or [cause.name for cause in CAUSES]
    logs = [one.log_evidence for one in explanations] or [0.0] * len(CAUSES)
    names += [STUCK, DROPOUT, CANNOT_TELL]
    logs += [max(best, nothing) + stuck if repeats else -np.inf, nothing + dropout if missing else -np.inf, nothing]
    weight = np.exp(np.array(logs) - log_sum(np.array(logs)))
    healthy_share = float(weight[-1])
    weight[-1] = 1.0 - weight[:-1].max()
    weight /= weight.sum()
    evidence: dict[str, tuple[Evidence | None, str]] = {one.cause.name: _evidence(one) for one in explanations}
    evidence[STUCK] = _of_stuck(repeats, window.step_s)
    evidence[DROPOUT] = _of_dropout(missing)
    evidence[CANNOT_TELL] = None, _why_not(names, weight, healthy_share, regression.speeds_after if judged else None)
    suspects = [
        RankedCause(name, float(share), *evidence.get(name, (None, "no speed to judge by")))
        for name, share in zip(names, weight, strict=True)
    ]
    return Diagnosis(tuple(sorted(suspects, key=lambda one: -one.probability)))


def _evidence(one: Explanation) -> tuple[Evidence, str]:
    cause, (size, low, high) = one.cause, (one.size, one.low, one.high)
    unit = "command" if cause.absolute else "relative"
    found = Evidence(cause.parameter, size, low, high, unit)
    if cause.absolute:
        return found, f"{cause.parameter} {size:+.3g} in units of the command (95 %: {low:.3g} to {high:.3g})"
    return found, f"{cause.parameter} {100 * size:+.0f} % (95 %: {100 * low:.0f} to {100 * high:.0f})"


def _of_stuck(repeats: int, step_s: float) -> tuple[Evidence | None, str]:
    if not repeats:
        return None, "the readings change"
    found = Evidence("repeated readings", repeats, repeats, repeats, "samples")
    return found, f"the last {repeats} readings are all the same, for {repeats * step_s:.2g} s"


def _of_dropout(missing: float) -> tuple[Evidence | None, str]:
    if not missing:
        return None, "no reading is missing"
    found = Evidence("missing readings", missing, missing, missing, "share")
    return found, f"{100 * missing:.0f} % of the readings are missing"


def _why_not(names: list[str], weight: Array, healthy_share: float, speeds_after: Array | None) -> str:
    first, second = np.argsort(-weight[:-1])[:2]
    if weight[-1] < weight[first] * CLEAR:
        return f"little doubt: {names[first]} is more than twice as probable as all others together"
    if speeds_after is None:
        return "cannot tell yet: too few speeds since the onset"
    if healthy_share > CLEAR:
        return "cannot tell yet: the torque balance is that of a healthy fan"
    low, high = np.quantile(speeds_after, (0.05, 0.95))
    if high - low < STILL * high:
        return "cannot tell yet: the command is not moving"
    return f"cannot tell yet: {names[first]} and {names[second]} explain it alike"
