"""What limits find: how far the speed of a fan must drop at a constant command to raise an alarm, and how soon.

At once: beyond the limit of a smoothed residual. Within a minute: also what the drift adds up in that time, while the
baseline follows the fan as long as every statistic is below half of its limit. A drop of the speed at a constant
command is a shift of the torque balance by the slope of the needed command over speed, viscous + 2 drag w; the residual
that finds the smaller drop counts. Noise is left out: a drop of this size is found about every second time so soon.
The baseline of the fan has learned at the mean speed of calibration.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from scoring.detectors.detector import Signal
from scoring.detectors.drift import Drift
from scoring.detectors.smoothed import Smoothed
from scoring.detectors.table import rows
from scoring.diagnosis.regression_window import HealthyBalance
from scoring.fan_scorer import FanScorer
from scoring.interval_scorer import HALF_LIMIT
from scoring.limits import Limits

MINUTE_S = 60.0
ROUNDS = 30
DEFAULT_PERIOD_S = 0.01
LEARNED_SCALE = np.ones(1)
"""of speed_scaling, at the mean speed of calibration"""
SHARES = (0.25, 0.5, 0.75, 1.0)
"""of the top speed, where drops are given"""


@dataclass(frozen=True)
class DetectableDrop:
    """At a speed, the drops that raise an alarm, rad/s; infinite where no drop does."""

    speed_rad_s: float
    at_once_rad_s: float
    within_a_minute_rad_s: float


def detectable_drops(
    limits: Limits, sigma_rad_s: float, balance: HealthyBalance, speeds_rad_s: Sequence[float]
) -> list[DetectableDrop]:
    """The drops at some speeds, of a fan with this sigma and balance. limits: of this fan alone."""
    scorer = FanScorer(1, limits)
    found = []
    for speed in speeds_rad_s:
        slope = balance.viscous + 2.0 * balance.drag * speed
        of_balance = balance.sigma_command / slope if slope > 0.0 else np.inf
        drops = [_drops(scorer, "speed", speed, sigma_rad_s), _drops(scorer, "balance", speed, of_balance)]
        at_once, in_a_minute = (min(column) for column in zip(*drops, strict=True))
        found.append(DetectableDrop(speed, at_once, min(at_once, in_a_minute)))
    return found


def _drops(scorer: FanScorer, source: Signal, speed_rad_s: float, rad_s_per_sigma: float) -> tuple[float, float]:
    """The drops by one residual, at once and within a minute, rad/s."""
    drifts, smoothed = [], np.inf
    limits = scorer.limits.residual(source)
    unit = float(scorer.residuals[source].limit_std(np.array([speed_rad_s]), LEARNED_SCALE)[0])
    """of the limits at this speed, sigma"""
    for row in rows():
        detector = scorer.detectors.get(row.name)
        if row.source != source or detector is None:
            continue
        if isinstance(detector, Drift):
            drifts += detector.sums
        elif isinstance(detector, Smoothed):
            smoothed = detector.limit_sigmas(_period_s(scorer)) / limits.mean_residual_std
    at_once = smoothed * unit * rad_s_per_sigma
    if not drifts or not np.isfinite(rad_s_per_sigma):
        return at_once, at_once
    timing, most = scorer.limits.timing, limits.baseline.adaptation_limit_sigmas / unit

    def is_found(shift: float) -> bool:
        baseline = 0.0
        sums = [0.0] * len(drifts)
        for _ in range(round(MINUTE_S)):
            left = shift - baseline
            sums = [max(0.0, total + left - drift.reference_sigmas) for total, drift in zip(sums, drifts, strict=True)]
            ratio = max(left / smoothed, *(s / drift.limit_sigma_s for s, drift in zip(sums, drifts, strict=True)))
            if ratio > 1.0:
                return True
            if ratio <= HALF_LIMIT:
                baseline = min(baseline + left / max(timing.adaptation_s, 1.0), most)
        return False

    low, high = 0.0, max(drift.reference_sigmas + drift.limit_sigma_s for drift in drifts) + 2.0 * most
    for _ in range(ROUNDS):
        middle = (low + high) / 2.0
        low, high = (low, middle) if is_found(middle) else (middle, high)
    return at_once, high * unit * rad_s_per_sigma


def _period_s(scorer: FanScorer) -> float:
    """The sampling period that the limits were found with."""
    of_drifts = [detector.period_s for detector in scorer.detectors.values() if isinstance(detector, Drift)]
    return of_drifts[0] if of_drifts else DEFAULT_PERIOD_S
