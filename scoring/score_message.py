"""The message `Score` of a block, in rad/s and command units."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np

from fantwin.schemas.channels import measured_columns
from fantwin.schemas.enums import FanState, InvalidReason, Statistic
from fantwin.schemas.messages import Array, Prediction, Score
from fantwin.scoring.samples import BALANCE_COUNTS, among, arrived
from fantwin.scoring.saved import Saved

BAND_SIGMAS = 2.0
NONE, WARMING_UP = np.uint8(InvalidReason.NONE), np.uint8(InvalidReason.WARMING_UP)
STANDS_BELOW_RAD_S = 1.0
"""A fan in alarm that reads less is not shown as one that is well again: at a low command, what it lacks may be within
the limit for a while."""
UNKNOWN, NORMAL, SUSPECT, ALARM, RETURNING = map(
    int, (FanState.UNKNOWN, FanState.NORMAL, FanState.SUSPECT, FanState.ALARM, FanState.RETURNING)
)
IDLE_STATES = (
    (np.uint8(InvalidReason.STOPPED), np.uint8(FanState.STOPPED)),
    (np.uint8(InvalidReason.STARTING), np.uint8(FanState.STARTING)),
)
"""reasons of a fan that is not scored because its command stops it, or has just started it"""


@dataclass(eq=False, kw_only=True)
class ScoreColumns(Saved):
    """Decisions on fans: (fans,) each, or (n, fans) for the rows of a block."""

    KEPT = (
        *("score", "statistic", "is_active", "is_returning"),
        *("expected_residual_rad_s", "expected_balance_command"),
    )
    SUSPECT_FROM: ClassVar[float] = 0.5
    """score from which a fan is suspect"""
    score: Array
    statistic: Array
    is_active: Array
    is_returning: Array
    expected_residual_rad_s: Array
    expected_balance_command: Array

    @classmethod
    def empty(cls, *shape: int) -> Self:
        """Make columns without knowledge of the fans."""
        return cls(
            score=np.zeros(shape),
            statistic=np.full(shape, int(Statistic.DEVIATION), np.uint8),
            is_active=np.zeros(shape, np.bool_),
            is_returning=np.zeros(shape, np.bool_),
            expected_residual_rad_s=np.zeros(shape),
            expected_balance_command=np.zeros(shape),
        )

    def fill(self, rows: slice, of: ScoreColumns) -> None:
        """Write what holds for some rows."""
        for name, column in vars(of).items():
            getattr(self, name)[rows] = column


def score_of(item: Prediction, of: ScoreColumns, reads_balance: Array, unseen_rad_s: Array | float) -> Score:
    """The message of a block. of: its rows. reads_balance: (fans,) as in `Fans`. unseen_rad_s: (n, fans) standard
    deviation of the twin's error where it was not trained."""
    has_balance = among(item.invalid_reason, *BALANCE_COUNTS) & np.isfinite(item.torque_balance_command) & reads_balance
    has_residual = item.valid & np.isfinite(item.measured_speed_rad_s) & np.isfinite(item.predicted_speed_rad_s)
    is_standing = of.is_active & (of.statistic == int(Statistic.STANDSTILL)) & arrived(item.invalid_reason)
    valid = has_residual | has_balance | is_standing
    band = BAND_SIGMAS * np.hypot(item.sigma_rad_s, unseen_rad_s)
    half_range = item.reading_range_rad_s if len(item.reading_range_rad_s) else np.zeros(valid.shape)
    state = np.where(of.score > of.SUSPECT_FROM, SUSPECT, NORMAL)
    is_returning = of.is_returning & ~(np.abs(item.measured_speed_rad_s) < STANDS_BELOW_RAD_S)
    state = np.where(of.is_active, np.where(is_returning, RETURNING, ALARM), state)
    state = np.where(valid, state, UNKNOWN)
    for reason, of_idle in IDLE_STATES:
        state = np.where((item.invalid_reason == reason) & ~valid, of_idle, state)
    why = np.where(item.invalid_reason == NONE, WARMING_UP, item.invalid_reason)
    return Score(
        fans=item.fans,
        period_ns=item.period_ns,
        t_ns=item.t_ns,
        command=item.command,
        measured_speed_rad_s=item.measured_speed_rad_s,
        predicted_speed_rad_s=item.predicted_speed_rad_s,
        band_variance=np.square(band + half_range),
        state=state.astype(np.uint8),
        valid=valid,
        invalid_reason=np.where(valid, NONE, why).astype(np.uint8),
        torque_balance_command=item.torque_balance_command,
        expected_residual_rad_s=of.expected_residual_rad_s,
        expected_balance_command=of.expected_balance_command,
        score=np.where(valid, of.score, np.nan),
        statistic=of.statistic,
        **measured_columns(item),
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
        state=np.full(unknown.shape, int(FanState.UNKNOWN), np.uint8),
        valid=np.zeros(unknown.shape, np.bool_),
        invalid_reason=why.astype(np.uint8),
        torque_balance_command=unknown,
        expected_residual_rad_s=unknown,
        expected_balance_command=unknown,
        score=unknown,
        statistic=np.zeros(unknown.shape, np.uint8),
        **measured_columns(item),
    )
