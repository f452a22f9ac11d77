"""The message `Score` of a block, in rad/s and command units."""

from __future__ import annotations

import numpy as np

from schemas.auxiliary import auxiliary_columns
from schemas.enums import FanState, InvalidReason
from schemas.messages import Array, Prediction, Score
from scoring.scored_block import ScoredBlock

BAND_SIGMAS = 2.0
NONE, WARMING_UP = np.uint8(InvalidReason.NONE), np.uint8(InvalidReason.WARMING_UP)
COMMISSIONING = np.uint8(FanState.COMMISSIONING)
IDLE_STATES = (
    (np.uint8(InvalidReason.STOPPED), np.uint8(FanState.STOPPED)),
    (np.uint8(InvalidReason.STARTING), np.uint8(FanState.STARTING)),
)
"""of a fan that is not scored because its command stops it, or has just started it"""


def score_of(item: Prediction, scored: ScoredBlock, state: Array, unseen: Array) -> Score:
    """The message of a block that was scored. state: (n, fans) of FanState. unseen: (n, fans), see Samples."""
    valid, sigma = np.isfinite(scored.score), item.sigma_rad_s
    band = BAND_SIGMAS * sigma * np.hypot(1.0, unseen)
    if len(item.reading_range_rad_s):
        band = band + item.reading_range_rad_s
    of_prediction = item.invalid_reason
    for reason, of_idle in IDLE_STATES:
        state = np.where((of_prediction == reason) & ~valid, of_idle, state)
    why = np.where(of_prediction == NONE, WARMING_UP, of_prediction)
    return Score(
        fans=item.fans,
        period_ns=item.period_ns,
        t_ns=item.t_ns,
        command=item.command,
        measured_speed_rad_s=item.measured_speed_rad_s,
        predicted_speed_rad_s=item.predicted_speed_rad_s,
        band_variance=band**2,
        smoothed_residual_rad_s=scored.speed_smoothed * sigma,
        state=np.where(scored.commissioning & ~valid, COMMISSIONING, state).astype(np.uint8),
        valid=valid,
        invalid_reason=np.where(valid, NONE, why).astype(np.uint8),
        torque_balance_command=item.torque_balance_command,
        speed_baseline_rad_s=scored.speed_baseline * sigma,
        balance_baseline_command=scored.balance_baseline * item.torque_balance_sigma_command,
        score=scored.score,
        statistic=scored.statistic,
        **auxiliary_columns(item),
    )


def unscored(item: Prediction) -> Score:
    """The message of a block that was not scored, because there is no twin."""
    unknown = np.full(item.command.shape, np.nan)
    why = np.where(item.invalid_reason == InvalidReason.NONE, InvalidReason.NO_TWIN, item.invalid_reason)
    return Score(
        fans=item.fans,
        period_ns=item.period_ns,
        t_ns=item.t_ns,
        command=item.command,
        measured_speed_rad_s=item.measured_speed_rad_s,
        predicted_speed_rad_s=unknown,
        band_variance=unknown,
        smoothed_residual_rad_s=unknown,
        state=np.full(unknown.shape, int(FanState.UNKNOWN), np.uint8),
        valid=np.zeros(unknown.shape, np.bool_),
        invalid_reason=why.astype(np.uint8),
        torque_balance_command=unknown,
        speed_baseline_rad_s=unknown,
        balance_baseline_command=unknown,
        score=unknown,
        statistic=np.zeros(unknown.shape, np.uint8),
        **auxiliary_columns(item),
    )
