"""Margins on limits from few data: running too short to set limits by rarity, or hardly long enough.

A few minutes may happen to be quiet, miss speeds that the fans will have, or show hardly any motion. And limits are
multiples of a standard deviation that few independent errors of the twin have shown, one for each speed of a fan: so
they are multiples of the upper end of its confidence interval.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from scipy.stats import chi2

from schemas.messages import Array
from scoring.baseline.healthy_residual import HealthyResidual
from scoring.calibration.evidence import count_std, evidence
from scoring.calibration.healthy_statistics import HealthyStatistics
from scoring.calibration.unvisited_speeds import wider_at_unvisited_speeds
from scoring.detectors.detector import Signal
from scoring.detectors.table import calibrated_rows
from scoring.limits import Limits

CONFIDENCE = 0.95
VISITED_S = 20.0  # a fan that turned at a speed for so long has shown the error of its twin there
LEAST_VISITED = 8  # limits beyond those of so few would find nothing
ALIKE = 3.0  # times the median sigma of the fans
MIN_TIME_ERROR_S = 0.2
"""of a twin while a fan changes its speed, standard deviation; three nights of racks show as much"""


def cautious(
    limits: Limits, found: HealthyStatistics, sigma_shares: Mapping[Signal, Array], *, knows_other_speeds: bool
) -> Limits:
    """Limits where the running is too short to set them by rarity; see DetectorSettings.cautious_factor.

    knows_other_speeds: whether it shows the residual at all speeds, so that no detector has to be left out.
    """
    limits = limits.with_residuals(lambda residual, _: _not_below_mean_over_speeds(residual))
    if not knows_other_speeds and count_std(limits, found) > 0.0:
        limits = limits.with_residuals(lambda residual, _: wider_at_unvisited_speeds(residual, found.top_speed_rad_s))
    if sigma_shares:
        limits = limits.with_residuals(
            lambda residual, source: _not_below_mean_over_fans(residual, sigma_shares[source])
        )
    visited = sum(int((seconds >= VISITED_S).sum()) for seconds in found.visited_s)
    independent = max(visited, LEAST_VISITED)
    unknown = math.sqrt(independent / float(chi2.ppf(1.0 - CONFIDENCE, independent)))
    used = [row for row in calibrated_rows() if row.name in limits.detectors]
    factors = {row.name: limits.detectors[row.name].cautious_factor(evidence(row, limits, found)) for row in used}
    limits = limits.scaled(
        {
            row.name: max(factors.get(row.name) or 1.0, 1.0 if row.source == "tacho" else unknown)
            for row in calibrated_rows()
        }
    )
    detectors = {
        row.name: limits.detectors[row.name].cautious(
            replace(evidence(row, limits, found), unknown_factor=1.0 if row.source == "tacho" else unknown)
        )
        for row in used
        if factors[row.name] is not None or knows_other_speeds
    }
    return limits.model_copy(update={"detectors": detectors})


def _not_below_mean_over_speeds(residual: HealthyResidual) -> HealthyResidual:
    """A few minutes at a speed may happen to be quiet: no standard deviation is below the mean over the speeds."""
    least = residual.mean_residual_std
    return residual.model_copy(update={"residual_std": tuple(max(std, least) for std in residual.residual_std)})


def widened_in_motion(limits: Limits, sigma_rad_s: float, period_s: float) -> Limits:
    """In some minutes fans may hardly move: limits of the speed widen as if the twin were off by a standard deviation
    in time, and by half a period, because it is not known when between two samples a command changed.
    """
    scale_rad_s = limits.speed.mean_residual_std * sigma_rad_s / (MIN_TIME_ERROR_S + 0.5 * period_s)
    scale_rad_s = min(limits.speed.transient_scale_rad_s or scale_rad_s, scale_rad_s)
    return limits.model_copy(update={"speed": limits.speed.model_copy(update={"transient_scale_rad_s": scale_rad_s})})


def _not_below_mean_over_fans(residual: HealthyResidual, sigma_shares: Array) -> HealthyResidual:
    """A fan whose tacho has little noise has a small sigma, but its twin, air and supply err as those of the others:
    no low-frequency standard deviation is below the root mean square over the fans.
    """
    relative = (math.sqrt(np.mean(np.square(alike(sigma_shares)))) / sigma_shares).clip(1.0, None)
    return residual.model_copy(update={"low_frequency_std_of_fans": tuple(np.round(relative, 4).tolist())})


def alike(sigma_of_fans: Array) -> Array:
    """Those of the fans without any that is far noisier than most: it is no measure for the others."""
    return sigma_of_fans[sigma_of_fans <= ALIKE * np.median(sigma_of_fans)]
