"""Limits of a twin from healthy running, with what its card says about its fans: the one way into calibration."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pipeline.runtime.tray_twin import TrayTwin
from schemas.messages import Array
from scoring.calibration.calibration import calibrate
from scoring.calibration.few_data import alike
from scoring.calibration.healthy_statistics import Runs
from scoring.detectors.detector import Signal
from scoring.limits import Limits, Timing


def find_limits(
    twins: Sequence[TrayTwin],
    runs: Runs,
    timing: Timing,
    false_alarms_per_day: float,
    *,
    seed: int = 0,
    extrapolate: bool = False,
    alarms_left_out: int = 0,
) -> Limits:
    """Limits with a declared number of false alarms per fan and day, common to twins of one kind of fan.

    The options, and what is raised: as `calibrate`.
    """
    bends_rad_s = [twin.bend_rad_s for twin in twins]
    known_rad_s = [bend_rad_s for bend_rad_s in bends_rad_s if bend_rad_s is not None]
    return calibrate(
        runs,
        max(twin.card.top_speed_rad_s for twin in twins),
        timing,
        false_alarms_per_day,
        seed,
        extrapolate,
        crossover_speed_rad_s=float(np.median(known_rad_s)) if len(known_rad_s) == len(bends_rad_s) else None,
        has_drive=all(twin.card.drive is not None for twin in twins),
        sigma_shares=_sigma_shares(twins[0]) if len(twins) == 1 else {},
        alarms_left_out=alarms_left_out,
        over_predicted_speed=any(tacho.held_s > 0.0 for twin in twins for tacho in twin.card.tacho),
        sigma_rad_s=float(np.mean(alike(np.concatenate([twin.sigma_rad_s for twin in twins])))),
    )


def _sigma_shares(twin: TrayTwin) -> dict[Signal, Array]:
    """(fans,) the sigma of each fan, of the speed relative to its full speed."""
    return {"speed": twin.sigma_rad_s / twin.full_speed_rad_s, "balance": twin.balance.sigma_command}
