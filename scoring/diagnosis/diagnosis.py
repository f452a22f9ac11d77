"""The probable causes of an alarm, with their evidence.

The balance of the window is compared with each single fault (scoring.diagnosis.hypotheses), the readings with those of
a broken sensor (scoring.diagnosis.sensor_evidence). All causes have the same prior probability, except that a changed
scale of the sensor has less.

Where the motion does not distinguish two faults, each keeps half the probability. `cannot_tell` gets the probability
that naming the first cause would be wrong, because another is true or because nothing changed. It comes first exactly
when the best cause is less probable than all the others together.

A stuck sensor carries no information about the motion, so its hypothesis gets the same likelihood for the balance as
the best of the others. A sensor that drops out is right whenever it gives a reading, so its balance has to be healthy.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from schemas.tacho import INSTANTANEOUS, Tacho
from scoring.diagnosis.advice import Advice
from scoring.diagnosis.current_evidence import GainOfCurrent, gain_of_current
from scoring.diagnosis.hypotheses import CAUSES, Comparison, Explanation, FaultHypothesis, log_sum
from scoring.diagnosis.regression_window import Array, HealthyBalance, RegressionWindow, Window
from scoring.diagnosis.sensor_evidence import (
    MAX_HEALTHY_MISSING,
    dropout_log_ratio,
    stuck_log_ratio,
    stuck_log_ratio_of_readings,
)
from scoring.diagnosis.shown_causes import CANNOT_TELL, short_name

STUCK, DROPOUT = "sensor_stuck", "sensor_dropout"
GAIN_DOWN = "gain_down"
DRIVER_SHARE = 0.5
"""of the prior probability of less drive: the other half is that of a weak supply"""
CANNOT_TELL_YET = "cannot tell yet"
ADVICE = Advice()
MIN_AFTER_ONSET_S = 0.2
CLEAR_RATIO = 0.5
"""the diagnosis is clear if `cannot_tell` has less than this share of the first cause's probability"""
STEADY_SHARE = 0.05
"""a speed that varies by less than this share excites nothing"""
DROPOUT_BEFORE_ONSET_S = 10.0
"""readings may have been missing for so long before their share exceeded its limit"""


@dataclass(frozen=True)
class Evidence:
    """The change of one parameter, with a 95 % interval.

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

    causes: tuple[RankedCause, ...]

    @property
    def first(self) -> RankedCause:
        """The most probable one."""
        return self.causes[0]


def diagnose(
    window: Window,
    healthy: HealthyBalance,
    advice: Advice = ADVICE,
    tacho: Tacho = INSTANTANEOUS[0],
    *,
    knows_supply: bool = False,
) -> Diagnosis:
    """Diagnose one fan from its last seconds, some before the onset of the fault and all since.

    advice: what to do to show the cause, if it is unclear. knows_supply: the command takes account of the measured
    supply voltage, so a weak supply is no cause of less drive.

    About three seconds of health before the onset are enough; the samples after it decide. The diagnosis can be
    repeated as samples arrive. It takes milliseconds.
    """
    heard = np.isfinite(window.command)  # where the command is missing too, the line was silent and not the sensor
    speed, onset = window.speed_rad_s[heard], int(np.count_nonzero(heard[: window.onset]))
    regression = RegressionWindow(window, healthy)
    if tacho.kind == "instantaneous":
        stuck, repeats = stuck_log_ratio(speed, onset)
    else:
        expected = np.broadcast_to(window.expected_rad_s, window.speed_rad_s.shape)[heard]
        stuck, repeats = stuck_log_ratio_of_readings(speed, expected, onset, tacho, window.period_s)
    lacks = ~np.isfinite(speed) if window.reading_missing is None else window.reading_missing[heard]
    dropout_onset = _first_missing(lacks, onset, window.period_s)
    if window.reading_missing is not None:
        dropout_onset = _most_probable_onset(lacks, dropout_onset, onset)
    dropout, missing = dropout_log_ratio(lacks, dropout_onset)
    enough = len(regression.speeds_after) * window.period_s >= MIN_AFTER_ONSET_S
    if enough:
        comparison = Comparison(regression, healthy)
        nothing = comparison.nothing()
        causes = [_without_supply(cause) if knows_supply else cause for cause in CAUSES]
        explanations = [comparison.explain(cause) for cause in causes]
    else:
        nothing, explanations = 0.0, []
    best = max((one.log_evidence for one in explanations), default=0.0)
    by_current = gain_of_current(window, healthy)
    if by_current is not None:
        explanations = [_with_current(one, by_current) for one in explanations]
    names = [one.cause.name for one in explanations] or [cause.name for cause in CAUSES]
    logs = [one.log_evidence for one in explanations] or [0.0] * len(CAUSES)
    names += [STUCK, DROPOUT, CANNOT_TELL]
    logs += [max(best, nothing) + stuck if repeats else -np.inf, nothing + dropout if missing else -np.inf, nothing]
    weight = np.exp(np.array(logs) - log_sum(np.array(logs)))
    healthy_share = float(weight[-1])
    weight[-1] = 1.0 - weight[:-1].max()
    weight /= weight.sum()
    evidence: dict[str, tuple[Evidence | None, str]] = {one.cause.name: _evidence(one) for one in explanations}
    if by_current is not None and GAIN_DOWN in evidence:
        found, sentence = evidence[GAIN_DOWN]
        evidence[GAIN_DOWN] = found, f"{sentence}, by the current {100 * by_current.change:+.0f} %"
    if knows_supply and GAIN_DOWN in evidence:
        found, sentence = evidence[GAIN_DOWN]
        evidence[GAIN_DOWN] = found, f"{sentence}, beyond the supply voltage, which is measured"
    evidence[STUCK] = _of_stuck(repeats, window.period_s)
    evidence[DROPOUT] = _of_dropout(missing, (len(speed) - dropout_onset) * window.period_s)
    unclear = _clarity(names, weight, healthy_share, regression.speeds_after if enough else None)
    if unclear.startswith(CANNOT_TELL_YET):
        unclear = advice.added_to(unclear, window, healthy)
    evidence[CANNOT_TELL] = None, unclear
    ranked = [
        RankedCause(name, float(share), *evidence.get(name, (None, "no speed to judge by")))
        for name, share in zip(names, weight, strict=True)
    ]
    return Diagnosis(tuple(sorted(ranked, key=lambda cause: -cause.probability)))


def _with_current(explanation: Explanation, by_current: GainOfCurrent) -> Explanation:
    """Less drive with what the current says of it; the other causes leave the drive as it is."""
    if explanation.cause.name != GAIN_DOWN:
        return explanation
    size_std = (explanation.high - explanation.low) / (2.0 * 1.96)
    ratio = by_current.log_ratio(explanation.size, size_std)
    return replace(explanation, log_evidence=explanation.log_evidence + ratio)


def _without_supply(cause: FaultHypothesis) -> FaultHypothesis:
    """The cause where the supply is known to be none of it: one of two reasons for less drive is left, the driver."""
    return replace(cause, weight=cause.weight * DRIVER_SHARE) if cause.name == GAIN_DOWN else cause


def _evidence(explanation: Explanation) -> tuple[Evidence, str]:
    cause, size, low, high = explanation.cause, explanation.size, explanation.low, explanation.high
    unit = "command" if cause.absolute else "relative"
    found = Evidence(cause.parameter, size, low, high, unit)
    if cause.absolute:
        return found, f"{cause.parameter} {size:+.3g} in units of the command (95 %: {low:.3g} to {high:.3g})"
    return found, f"{cause.parameter} {100 * size:+.0f} % (95 %: {100 * low:.0f} to {100 * high:.0f})"


def _of_stuck(repeats: int, period_s: float) -> tuple[Evidence | None, str]:
    if not repeats:
        return None, "the readings change"
    found = Evidence("repeated readings", repeats, repeats, repeats, "samples")
    return found, f"the last {repeats} readings are all the same, for {repeats * period_s:.2g} s"


def _first_missing(lacks: NDArray[np.bool_], onset: int, period_s: float) -> int:
    """Since when readings are missing: the first missing one of the last seconds before the onset, or the onset."""
    first = max(0, onset - round(DROPOUT_BEFORE_ONSET_S / period_s))
    missing = np.flatnonzero(lacks[first:onset])
    return first + int(missing[0]) if len(missing) else onset


def _most_probable_onset(lacks: NDArray[np.bool_], first: int, onset: int) -> int:
    """The missing reading, not before the first and not after the onset, from which on most more are missing than of a
    good line: a healthy one of seconds before does not count."""
    missing = first + np.flatnonzero(lacks[first:onset])
    if not len(missing):
        return onset
    excess = np.cumsum(lacks - MAX_HEALTHY_MISSING)
    return int(missing[np.argmin((excess - lacks)[missing])])


def _of_dropout(missing: float, seconds: float) -> tuple[Evidence | None, str]:
    """The evidence of missing readings. seconds: time over which their share was counted."""
    if not missing:
        return None, "no reading is missing"
    found = Evidence("missing readings", missing, missing, missing, "share")
    return found, f"{100 * missing:.0f} % of the readings of the last {seconds:.2g} s are missing"


def _clarity(names: list[str], weight: Array, healthy_share: float, speeds_after: Array | None) -> str:
    """Why the cause is unclear, or that it is clear."""
    first, second = np.argsort(-weight[:-1])[:2]
    one, other = (short_name(names[each]) for each in (first, second))
    if weight[-1] < weight[first] * CLEAR_RATIO:
        return f"little doubt: {one} is more than twice as probable as all others together"
    if speeds_after is None:
        return f"{CANNOT_TELL_YET}: too few speeds since the onset"
    if healthy_share > 0.5:
        return f"{CANNOT_TELL_YET}: the torque balance is that of a healthy fan"
    low, high = np.quantile(speeds_after, (0.05, 0.95))
    if high - low < STEADY_SHARE * high:
        return f"{CANNOT_TELL_YET}: the speed has changed too little since the alarm began"
    return f"{CANNOT_TELL_YET}: {one} and {other} explain it alike"
