"""Traces of a tray: its scores joined in time, in its display unit, and the words for the state of a fan.

Where no samples came, lines and bands have a hole: nothing was judged there, and a line across it would say so.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from fantwin.schemas.channels import CHANNELS
from fantwin.schemas.enums import FanState, InvalidReason
from fantwin.schemas.fan_names import NO_NAMES, FanNames
from fantwin.schemas.fields import LARGEST_ENUM_VALUE
from fantwin.schemas.messages import Array, Score
from fantwin.schemas.units import RAD_S_PER_UNIT, SpeedUnit
from fantwin.scoring.alarms.unscored_monitor import REASONS

SILENT = "silent"
"""the state of a fan without samples, in words"""
NO_SAMPLES = LARGEST_ENUM_VALUE
"""the state of a row of a trace at which samples began to be missing"""
BRIDGED_PERIODS = 2.5
"""samples at most so far apart are joined by a line"""
IN_ALARM = (FanState.ALARM, FanState.RETURNING)
TRACE_COLUMNS = (
    "measured_speed_rad_s",
    "predicted_speed_rad_s",
    "band_variance",
    "valid",
    "state",
    "invalid_reason",
    "torque_balance_command",
    "expected_balance_command",
    "score",
)
"""the columns of a score that a trace is made of, its times apart"""
MEASURED_COLUMNS = (*TRACE_COLUMNS, *(column.name for column in CHANNELS))
"""the same with those that a source may measure beside command and speed"""


@dataclass(frozen=True, eq=False)
class Trace:
    """A stretch of one tray. Columns are (n, fans) unless noted; speeds are in `speed_unit`.

    Attributes:
        fan_numbers: (fans,) the fan of each column, counted from 0.
        t_ns: (n,) time of the samples, ns since the epoch.
        measured: NaN without a tacho reading.
        predicted, half_width: the twin and half the height of its band; NaN if the sample is not scored.
        outside: the sample is scored and lies outside the band.
        in_alarm: an alarm was active at the sample.
        balance, expected_balance: torque balance and what is expected of this fan, in units of the command; NaN if not
            scored.
        score: 1 is at the limit; NaN if not scored.
        state, invalid_reason: `FanState` and `InvalidReason`; at the beginning of a hole `NO_SAMPLES`.
        auxiliary: what the source measures beside command and speed, by the name of its column; NaN where unknown.
    """

    tray: str
    speed_unit: SpeedUnit
    fan_numbers: Sequence[int]
    t_ns: Array
    measured: Array
    predicted: Array
    half_width: Array
    outside: Array
    valid: Array
    in_alarm: Array
    balance: Array
    expected_balance: Array
    score: Array
    state: Array
    invalid_reason: Array
    auxiliary: Mapping[str, Array] = field(default_factory=dict[str, Array])
    names: FanNames = NO_NAMES

    @property
    def fans(self) -> int:
        """Number of fans in the trace."""
        return self.measured.shape[1]


def trace_of(
    tray: str,
    scores: Sequence[Score],
    speed_unit: SpeedUnit,
    fans: Sequence[int] | None = None,
    names: FanNames = NO_NAMES,
) -> Trace:
    """Join the scores of one tray, of which only `TRACE_COLUMNS` are needed.

    Args:
        tray: its name.
        scores: at least one, all with the same number of fans.
        speed_unit: unit of the speeds in the trace.
        fans: which fans, counted from 0; all if not given.
        names: of all fans of the tray.
    """
    scale = 1.0 / RAD_S_PER_UNIT[speed_unit]
    fan_numbers = range(scores[0].fans) if fans is None else fans
    chosen = slice(None) if fans is None else np.asarray(fans, np.intp)

    def column(name: str) -> Array:
        return np.concatenate([getattr(score, name)[:, chosen] for score in scores])

    present = [each.name for each in CHANNELS if any(len(getattr(score, each.name)) for score in scores)]
    valid = column("valid")
    state = column("state")
    return Trace(
        tray=tray,
        speed_unit=speed_unit,
        fan_numbers=fan_numbers,
        t_ns=np.concatenate([score.t_ns for score in scores]),
        measured=column("measured_speed_rad_s") * scale,
        predicted=np.where(valid, column("predicted_speed_rad_s") * scale, np.nan),
        half_width=np.where(valid, np.sqrt(column("band_variance")) * scale, np.nan),
        outside=column("outside") & valid,
        valid=valid,
        in_alarm=np.isin(state, IN_ALARM) & valid,
        balance=np.where(valid, _known_or_nan("torque_balance_command", scores)[:, chosen], np.nan),
        expected_balance=np.where(valid, _known_or_nan("expected_balance_command", scores)[:, chosen], np.nan),
        score=np.where(valid, column("score"), np.nan),
        state=state,
        invalid_reason=column("invalid_reason"),
        auxiliary={name: _known_or_nan(name, scores)[:, chosen] for name in present},
        names=names,
    )


def _known_or_nan(name: str, scores: Sequence[Score]) -> Array:
    """A column of scores of which some may not have it."""
    return np.concatenate(
        [of if len(of := getattr(score, name)) else np.full((len(score.t_ns), score.fans), np.nan) for score in scores]
    )


def with_holes(trace: Trace, period_ns: int, before_t_ns: int | None = None) -> Trace:
    """The trace with a row wherever samples begin to be missing: NaN, and `NO_SAMPLES`.

    Args:
        trace: a stretch of samples.
        period_ns: between two samples.
        before_t_ns: time of the sample before the trace; None: there is none.
    """
    before_t_ns = int(trace.t_ns[0]) if before_t_ns is None else before_t_ns
    steps = np.diff(trace.t_ns, prepend=before_t_ns)
    rows = np.flatnonzero(steps > BRIDGED_PERIODS * period_ns)
    if not len(rows):
        return trace
    began_t_ns = trace.t_ns[rows] - steps[rows] + period_ns

    def holed(column: Array, value: float) -> Array:
        return np.insert(column, rows, value, axis=0)

    floats = ("measured", "predicted", "half_width", "balance", "expected_balance", "score")
    flags = ("outside", "valid", "in_alarm", "invalid_reason")
    return replace(
        trace,
        t_ns=np.insert(trace.t_ns, rows, began_t_ns),
        state=holed(trace.state, NO_SAMPLES),
        auxiliary={name: holed(column, np.nan) for name, column in trace.auxiliary.items()},
        **{name: holed(getattr(trace, name), np.nan) for name in floats},
        **{name: holed(getattr(trace, name), 0) for name in flags},
    )


def state_name(state: int, invalid_reason: int) -> str:
    """A state in words; UNKNOWN with its reason: `unknown: no speed`. A value of a newer scorer reads `unknown (9)`."""
    if state == NO_SAMPLES:
        return SILENT
    if state != FanState.UNKNOWN or invalid_reason == InvalidReason.NONE:
        return FanState(state).words
    reason = InvalidReason(invalid_reason)
    return f"unknown: {REASONS.get(reason, reason.words)}"


def state_names() -> list[str]:
    """Every name that `state_name` gives for known values, in the order of a legend."""
    known = [state.words for state in FanState if state != FanState.UNKNOWN]
    return [*known, SILENT, *(state_name(FanState.UNKNOWN, reason) for reason in InvalidReason)]


def state_codes(state: Array, invalid_reason: Array) -> Array:
    """A number for each state and, if it is UNKNOWN, its reason: equal numbers have the same `state_name`."""
    return state.astype(np.int64) * (LARGEST_ENUM_VALUE + 1) + np.where(state == FanState.UNKNOWN, invalid_reason, 0)


def state_changes(trace: Trace, column: int, previous: str | None) -> tuple[Array, list[str]]:
    """Times (k,) in ns of the state changes of the fan in a column, and the k new names. `previous` is the state before
    the trace."""
    codes = state_codes(trace.state[:, column], trace.invalid_reason[:, column])
    first = np.flatnonzero(np.diff(codes, prepend=codes[0] - 1))
    names = [state_name(trace.state[i, column], trace.invalid_reason[i, column]) for i in first]
    if names and names[0] == previous:
        first, names = first[1:], names[1:]
    return trace.t_ns[first], names
