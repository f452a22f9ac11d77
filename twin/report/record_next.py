"""What to record next, so that more data narrow the error of a twin most."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fantwin.schemas.model_uncertainty import ModelUncertainty
from fantwin.schemas.twin_card import DriveCard
from fantwin.twin.report.steady_states import StaticCurve

LEAST_RATIO = 1.5
"""to the standard deviation where the twin was trained: more data of the same kind hardly reduce a smaller one"""


@dataclass(frozen=True)
class LeastKnown:
    """A speed, rad/s, and a command at which the twin may be most wrong, rad/s; held: the fan settles there."""

    speed_rad_s: float
    command: float
    std_rad_s: float
    held: bool


def least_known(known: ModelUncertainty, curve: StaticCurve, drive: DriveCard | None) -> LeastKnown | None:
    """The held command, or else the step from one settled speed, at which the twin may be most wrong.

    known, curve, drive: of the fan; curve over the commands that are possible. None: nothing within these commands is
    much less known than what training has seen.
    """
    settled = curve.twin[np.isfinite(curve.twin).all(axis=1)]
    if not len(settled):
        return None
    commands, speeds_rad_s = settled.T
    raised = drive.raised(commands[:, np.newaxis])[:, 0] if drive else commands
    of_steps = known.over(speeds_rad_s, raised)
    of_holds = np.diag(of_steps)
    least = LEAST_RATIO * known.seen_std_rad_s[0]
    if of_holds.max() >= least:
        at = int(of_holds.argmax())
        return LeastKnown(float(speeds_rad_s[at]), float(commands[at]), float(of_holds[at]), held=True)
    start, end = np.unravel_index(int(of_steps.argmax()), of_steps.shape)
    if of_steps[start, end] < least:
        return None
    return LeastKnown(float(speeds_rad_s[start]), float(commands[end]), float(of_steps[start, end]), held=False)
