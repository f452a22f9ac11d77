"""What is drawn of a tray: scores put end to end, in the unit that people are shown. Shared by viewer and plots."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from schemas.messages import Array, FanState, InvalidReason, Score
from schemas.units import RAD_S_PER_UNIT, SpeedUnit

IN_ALARM = (FanState.ALARM, FanState.RETURNING)


@dataclass(frozen=True, eq=False)
class Trace:
    """A stretch of one tray. Columns are (n, fans) unless said; speeds are in `speed_unit`.

    Attributes:
        t_ns: (n,) time of the samples, ns since the epoch.
        measured: NaN where the tacho gave none.
        predicted, half_width: the twin and half the height of its band, NaN where a sample is not judged.
        outside: the sample was judged and lies outside the band.
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
        """How many fans the tray has."""
        return self.measured.shape[1]


def trace_of(tray: str, scores: Sequence[Score], speed_unit: SpeedUnit) -> Trace:
    """Put the scores of one tray end to end; `scores` must not be empty and must have the same number of fans."""
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
    """A state as people read it; an unknown state says why: `unknown: gap`."""
    if state != FanState.UNKNOWN:
        return FanState(state).name.lower()
    reason = InvalidReason(invalid_reason).name.lower().replace("_", " ")
    return "unknown" if invalid_reason == InvalidReason.NONE else f"unknown: {reason}"


def state_names() -> list[str]:
    """Every name `state_name` can give, in the order of severity a legend wants."""
    judged = [state.name.lower() for state in FanState if state != FanState.UNKNOWN]
    return judged + [state_name(FanState.UNKNOWN, why) for why in InvalidReason]


def state_changes(trace: Trace, fan: int, previous: str | None) -> tuple[Array, list[str]]:
    """When a fan's state changed, and to what: times (k,) in ns, k names. `previous` is the state before the trace."""
    codes = trace.state[:, fan].astype(np.int64) * len(InvalidReason) + np.where(
        trace.state[:, fan] == FanState.UNKNOWN, trace.invalid_reason[:, fan], 0
    )
    first = np.flatnonzero(np.diff(codes, prepend=codes[0] - 1))
    names = [state_name(trace.state[i, fan], trace.invalid_reason[i, fan]) for i in first]
    if names and names[0] == previous:
        first, names = first[1:], names[1:]
    return trace.t_ns[first], names
