"""The data drawn for a tray: scores joined in time, in the tray's display unit. Shared by viewer and plots."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from schemas.fields import LARGEST_ENUM_VALUE
from schemas.messages import Array, FanState, InvalidReason, Score
from schemas.units import RAD_S_PER_UNIT, SpeedUnit

IN_ALARM = (FanState.ALARM, FanState.RETURNING)


@dataclass(frozen=True, eq=False)
class Trace:
    """A stretch of one tray. Columns are (n, fans) unless noted; speeds are in `speed_unit`.

    Attributes:
        t_ns: (n,) time of the samples, ns since the epoch.
        measured: NaN without a tacho reading.
        predicted, half_width: the twin and half the height of its band; NaN if the sample is not scored.
        outside: the sample is scored and lies outside the band.
        in_alarm: an alarm was active at the sample.
        state, invalid_reason: `FanState` and `InvalidReason`.
    """

    tray: str
    speed_unit: SpeedUnit
    t_ns: Array
    measured: Array
    predicted: Array
    half_width: Array
    outside: Array
    valid: Array
    in_alarm: Array
    state: Array
    invalid_reason: Array

    @property
    def fans(self) -> int:
        """Number of fans of the tray."""
        return self.measured.shape[1]


def trace_of(tray: str, scores: Sequence[Score], speed_unit: SpeedUnit) -> Trace:
    """Join the scores of one tray. `scores` must not be empty and must have the same number of fans."""
    scale = 1.0 / RAD_S_PER_UNIT[speed_unit]

    def column(name: str) -> Array:
        return np.concatenate([getattr(score, name) for score in scores])

    valid = column("valid")
    state = column("state")
    return Trace(
        tray=tray,
        speed_unit=speed_unit,
        t_ns=column("t_ns"),
        measured=column("measured_speed_rad_s") * scale,
        predicted=np.where(valid, column("predicted_speed_rad_s") * scale, np.nan),
        half_width=np.where(valid, np.sqrt(column("band_variance")) * scale, np.nan),
        outside=column("outside") & valid,
        valid=valid,
        in_alarm=np.isin(state, IN_ALARM) & valid,
        state=state,
        invalid_reason=column("invalid_reason"),
    )


def state_name(state: int, invalid_reason: int) -> str:
    """A state in words; UNKNOWN with its reason: `unknown: gap`. A value of a newer scorer reads `unknown (9)`."""
    if state != FanState.UNKNOWN or invalid_reason == InvalidReason.NONE:
        return FanState(state).words
    return f"unknown: {InvalidReason(invalid_reason).words}"


def state_names() -> list[str]:
    """Every name that `state_name` gives for known values, in the order of a legend."""
    known = [state.words for state in FanState if state != FanState.UNKNOWN]
    return known + [state_name(FanState.UNKNOWN, reason) for reason in InvalidReason]


def state_changes(trace: Trace, fan: int, previous: str | None) -> tuple[Array, list[str]]:
    """Times (k,) in ns of a fan's state changes, and the k new names. `previous` is the state before the trace."""
    codes = trace.state[:, fan].astype(np.int64) * (LARGEST_ENUM_VALUE + 1) + np.where(
        trace.state[:, fan] == FanState.UNKNOWN, trace.invalid_reason[:, fan], 0
    )
    first = np.flatnonzero(np.diff(codes, prepend=codes[0] - 1))
    names = [state_name(trace.state[i, fan], trace.invalid_reason[i, fan]) for i in first]
    if names and names[0] == previous:
        first, names = first[1:], names[1:]
    return trace.t_ns[first], names
