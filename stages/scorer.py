"""Scorer: measured against predicted; the band, and an alarm that needs a lasting excursion.

Reads: topic `prediction` (measured and predicted speed rad/s, sigma rad/s).
Writes: topic `score` (residual, smoothed residual, band rad/s, state), and `alarm` when one is raised or cleared.
Timing: a score for every prediction, at once, block for block; delays count the valid samples' own time.

Three things, kept apart. The *score* is the residual, smoothed by a first-order low-pass. The *threshold* is in healthy
standard deviations, with a deadband for the way back. The *state* follows the alarms of OPC UA Part 9: on-delay,
active, off-delay. The +-2 sigma band is shown beside them and is no alarm. See docs/deciding.md.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Self

import numpy as np
from pydantic import Field, model_validator

from pipeline.config import RAD_S_PER_UNIT, SpeedUnit
from pipeline.stage import Context, Core, Parts, Stage, StageConfig
from schemas.messages import Alarm, Array, FanState, Prediction, Score, Severity, WhyNot

NS_PER_S = 1_000_000_000
BAND_SIGMAS = 2.0
UNKNOWN, NORMAL, SUSPECT, ALARM, RETURNING = map(int, FanState)
FIRST_WARM_UP_NS = 60 * NS_PER_S  # a fan that was never judged may warm up for so long before that is told
IN_WORDS = {
    WhyNot.NONE: "no reason given",
    WhyNot.STALE: "the line is silent",
    WhyNot.GAP: "samples are missing",
    WhyNot.WARMING_UP: "the twin is warming up",
    WhyNot.OUT_OF_RANGE: "the command is out of the twin's range, or a value is no number",
    WhyNot.SATURATED: "saturated",
    WhyNot.NO_SPEED: "no speed",
    WhyNot.NO_TWIN: "the twin does not fit the grid's rate",
}


class ScorerConfig(StageConfig):
    """Section `[scorer]`."""

    smoothing_s: float = Field(default=0.2, ge=0, description="time constant of the residual's low-pass; 0 for none")
    alarm_sigmas: float = Field(default=2.0, gt=0, description="alarm limit on the smoothed residual, in sigma")
    deadband_sigmas: float = Field(default=0.5, ge=0, description="so much below the limit an alarm begins to return")
    on_delay_s: float = Field(default=0.5, ge=0, description="how long the limit must be exceeded to raise")
    off_delay_s: float = Field(default=1.0, ge=0, description="how long a return must last to clear")
    not_judged_s: float = Field(
        default=10.0, gt=0, description="a fan that is not judged for so long is told; above twin_integrator.warm_up_s"
    )

    @model_validator(mode="after")
    def _can_return(self) -> Self:
        if self.deadband_sigmas >= self.alarm_sigmas:
            raise ValueError("deadband_sigmas must be below alarm_sigmas, or no alarm could ever clear")
        return self


class Smoother:
    """The score: a first-order low-pass of the residual, discretised exactly. Starts at each fan's first sample."""

    def __init__(self, fans: int, time_constant_s: float) -> None:
        self._time_constant_s = time_constant_s
        self.smoothed = np.full(fans, np.nan)
        """(fans,) rad/s, NaN before a fan's first valid sample"""

    def update(self, residual: Array, valid: Array, step_s: float) -> Array:
        """Take a block of residuals. Fans that are not valid keep their value. All (n, fans), as is what returns."""
        keep = math.exp(-step_s / self._time_constant_s) if self._time_constant_s > 0 else 0.0
        smoothed = np.empty_like(residual)
        before = self.smoothed
        some_begin = keep == 0.0 or bool(np.isnan(before).any())  # without smoothing what overflows is no number either
        some_stay = not valid.all()
        for new, stays, now in zip(residual, ~valid, smoothed, strict=True):
            start = np.where(np.isnan(before), new, before) if some_begin else before
            np.subtract(start, new, out=now)  # now = new + keep * (start - new)
            np.multiply(keep, now, out=now)
            np.add(new, now, out=now)
            if some_stay:
                np.copyto(now, before, where=stays)
            before = now
        self.smoothed = before.copy()
        return smoothed


@dataclass(frozen=True)
class Threshold:
    """When an excursion begins, and when it is over; multiples of sigma."""

    alarm_sigmas: float
    deadband_sigmas: float

    def limit(self, sigma: Array) -> Array:
        """What the smoothed residual must exceed."""
        return self.alarm_sigmas * sigma

    def return_limit(self, sigma: Array) -> Array:
        """What it must fall below to return."""
        return (self.alarm_sigmas - self.deadband_sigmas) * sigma


@dataclass(frozen=True, order=True)
class Change:
    """An alarm raised (or cleared) at a row of a block."""

    row: int
    fan: int
    raised: bool
    onset_t_ns: int


@dataclass(frozen=True)
class Course:
    """What a block did to the states. state: (n, fans) of FanState after each sample, UNKNOWN where it is not valid."""

    state: Array
    changes: list[Change]
    too_short: int


class AlarmState:
    """One fan's state: NORMAL, SUSPECT (on-delay runs), ALARM, RETURNING (off-delay runs)."""

    def __init__(self, on_delay_ns: int, off_delay_ns: int) -> None:
        self._on_delay_ns = on_delay_ns
        self._off_delay_ns = off_delay_ns
        self.state = NORMAL
        self.onset_t_ns = 0
        """First sample of the present excursion; meaningless when NORMAL."""
        self._lasted_ns = 0  # how long the condition of SUSPECT or RETURNING has held

    @property
    def is_active(self) -> bool:
        """Whether an alarm was raised and not cleared."""
        return self.state in (ALARM, RETURNING)

    def update(self, t_ns: int, step_ns: int, exceeds: bool, returns: bool) -> None:
        """Take a valid sample: whether the score is beyond the limit, or below the limit of return."""
        if self.is_active and not returns:
            self.state = ALARM
        elif self.is_active:
            self._lasted_ns = 0 if self.state == ALARM else self._lasted_ns + step_ns
            self.state = NORMAL if self._lasted_ns >= self._off_delay_ns else RETURNING
        elif not exceeds:
            self.state = NORMAL
        else:
            if self.state == NORMAL:
                self.onset_t_ns = t_ns
            self._lasted_ns = 0 if self.state == NORMAL else self._lasted_ns + step_ns
            self.state = ALARM if self._lasted_ns >= self._on_delay_ns else SUSPECT


class AlarmStates:
    """The states of a tray's fans over blocks. Samples that are not valid leave state and timers alone."""

    def __init__(self, fans: int, on_delay_ns: int, off_delay_ns: int) -> None:
        self._fans = [AlarmState(on_delay_ns, off_delay_ns) for _ in range(fans)]
        self._not_normal = np.zeros(fans, np.bool_)

    def update(self, t_ns: Array, step_ns: int, exceeds: Array, returns: Array, valid: Array) -> Course:
        """Take a block. t_ns: (n,). The others, (n, fans): see AlarmState."""
        state = np.where(valid, NORMAL, UNKNOWN).astype(np.uint8)
        changes: list[Change] = []
        too_short = 0
        for fan in np.flatnonzero(self._not_normal | (exceeds & valid).any(axis=0)).tolist():
            one, rows = self._fans[fan], np.flatnonzero(valid[:, fan])
            samples = (rows, t_ns[rows], exceeds[rows, fan], returns[rows, fan])
            for row, time_ns, beyond, back in zip(*(column.tolist() for column in samples), strict=True):
                was, was_active = one.state, one.is_active
                one.update(time_ns, step_ns, beyond, back)
                state[row, fan] = one.state
                too_short += was == SUSPECT and one.state == NORMAL
                if one.is_active != was_active:
                    changes.append(Change(row, fan, one.is_active, one.onset_t_ns))
            self._not_normal[fan] = one.state != NORMAL
        return Course(state, sorted(changes), too_short)


class NotJudged:
    """For how long each fan has not been judged, in the time of its samples, and why."""

    def __init__(self, fans: int, limit_ns: int) -> None:
        self._limit_ns = limit_ns
        self._lasted_ns = np.zeros(fans, np.int64)
        self._why_not = np.zeros(fans, np.uint8)
        self._was_judged = np.zeros(fans, np.bool_)

    def update(self, step_ns: int, valid: Array, why_not: Array) -> None:
        """Take a block, (n, fans) each."""
        judged = valid.any(axis=0)
        since = np.where(judged, np.argmax(valid[::-1], axis=0), len(valid))
        self._lasted_ns = np.where(judged, 0, self._lasted_ns) + since * step_ns
        self._why_not = why_not[-1]
        self._was_judged |= judged

    def problem(self) -> str:
        """Which fans are not judged; times only as multiples, so that the line does not change all the time."""
        first_warm_up = ~self._was_judged & (self._why_not == WhyNot.WARMING_UP)
        limit_ns = np.where(first_warm_up, max(self._limit_ns, FIRST_WARM_UP_NS), self._limit_ns)
        late = self._lasted_ns >= limit_ns
        parts = []
        for why in np.unique(self._why_not[late]).tolist():
            fans = np.flatnonzero(late & (self._why_not == why))
            doubled = int(self._lasted_ns[fans].min() // self._limit_ns).bit_length() - 1
            names = ", ".join(map(str, fans.tolist()))
            who = f"fan {names} is" if len(fans) == 1 else f"fans {names} are"
            lasted_s = self._limit_ns * 2**doubled / NS_PER_S
            parts.append(f"{who} not judged: {IN_WORDS[WhyNot(why)]} for {lasted_s:g} s and more")
        return "; ".join(parts)


class ScorerCore(Core):
    """One tray's fans, each judged for itself."""

    def __init__(self, fans: int, speed_unit: SpeedUnit, config: ScorerConfig) -> None:
        self._fans = fans
        self._unit = speed_unit
        self._on_delay_s = config.on_delay_s
        self._off_delay_s = config.off_delay_s
        self._smoother = Smoother(fans, config.smoothing_s)
        self._threshold = Threshold(config.alarm_sigmas, config.deadband_sigmas)
        on_delay_ns, off_delay_ns = round(config.on_delay_s * NS_PER_S), round(config.off_delay_s * NS_PER_S)
        self._states = AlarmStates(fans, on_delay_ns, off_delay_ns)
        self._not_judged = NotJudged(fans, max(1, round(config.not_judged_s * NS_PER_S)))
        self._last_t_ns = np.iinfo(np.int64).min
        self._wrong_fans = 0
        self._counts: Counter[str] = Counter()

    def step(self, item: Prediction) -> list[Score | Alarm]:
        """Judge a block: its score, and then the alarms it raised or cleared."""
        if item.fans != self._fans:
            self._wrong_fans = item.fans
            self._counts["lost_wrong_fan_count"] += len(item.t_ns)
            return []
        self._wrong_fans = 0
        before = np.maximum.accumulate(np.concatenate(([self._last_t_ns], item.t_ns)))[:-1]
        new = item.t_ns > before
        self._counts["repeated"] += int((~new).sum())
        if not new.any():
            return []
        self._last_t_ns = int(item.t_ns[new][-1])
        t_ns, measured, predicted = item.t_ns[new], item.measured_speed_rad_s[new], item.predicted_speed_rad_s[new]
        residual = measured - predicted
        finite = np.isfinite(residual)
        valid = item.valid[new] & finite
        smoothed = self._smoother.update(residual, valid, item.step_ns / NS_PER_S)
        limit, return_limit = self._threshold.limit(item.sigma_rad_s), self._threshold.return_limit(item.sigma_rad_s)
        size = np.abs(smoothed)
        course = self._states.update(t_ns, item.step_ns, size > limit, size < return_limit, valid)
        self._counts["excursions_too_short"] += course.too_short
        alarms = [
            self._alarm(change, int(t_ns[change.row]), float(smoothed[change.row, change.fan]), limit, return_limit)
            for change in course.changes
        ]
        why_not = np.where(item.valid[new] & ~finite, WhyNot.OUT_OF_RANGE, item.why_not[new]).astype(np.uint8)
        self._not_judged.update(item.step_ns, valid, why_not)
        band = BAND_SIGMAS * item.sigma_rad_s
        score = Score(
            fans=self._fans,
            step_ns=item.step_ns,
            t_ns=t_ns,
            command=item.command[new],
            measured_speed_rad_s=measured,
            predicted_speed_rad_s=predicted,
            lower_bound_rad_s=predicted - band,
            upper_bound_rad_s=predicted + band,
            band_variance=np.broadcast_to(band**2, residual.shape),
            residual_rad_s=residual,
            smoothed_residual_rad_s=smoothed,
            outside=np.abs(residual) > band,
            state=course.state,
            valid=valid,
            why_not=why_not,
        )
        return [score, *alarms]

    def counters(self) -> Mapping[str, int]:
        """docs/deciding.md says what each counts."""
        return dict(self._counts)

    def problem(self) -> str:
        """Predictions of another number of fans, or fans that have not been judged for long."""
        if self._wrong_fans:
            return f"predictions of {self._wrong_fans} fans, [[tray]] says fans = {self._fans}: correct one of them"
        return self._not_judged.problem()

    def _alarm(self, change: Change, t_ns: int, residual_rad_s: float, limit: Array, return_limit: Array) -> Alarm:
        fan, raised = change.fan, change.raised
        crossed = float((limit if raised else return_limit)[fan])
        self._counts["alarms_raised" if raised else "alarms_cleared"] += 1
        return Alarm(
            fan=fan,
            active=raised,
            severity=Severity.ALARM,
            t_ns=t_ns,
            onset_t_ns=change.onset_t_ns,
            residual_rad_s=residual_rad_s,
            limit_rad_s=crossed,
            message=self._raised(fan, residual_rad_s, crossed) if raised else self._cleared(fan, crossed),
        )

    def _raised(self, fan: int, residual_rad_s: float, limit_rad_s: float) -> str:
        side = "below" if residual_rad_s < 0 else "above"
        size, limit = self._shown(abs(residual_rad_s)), self._shown(limit_rad_s)
        return f"fan {fan}: {size} {self._unit} {side} the twin for {self._on_delay_s:g} s (limit {limit})"

    def _cleared(self, fan: int, limit_rad_s: float) -> str:
        limit = self._shown(limit_rad_s)
        return f"fan {fan}: back within {limit} {self._unit} of the twin for {self._off_delay_s:g} s"

    def _shown(self, speed_rad_s: float) -> str:
        speed = speed_rad_s / RAD_S_PER_UNIT[self._unit]
        return f"{speed:.0f}" if speed >= 10 else f"{speed:.2g}"


def build(context: Context) -> Parts:
    """The core of one tray."""
    return Parts(ScorerCore(context.tray.fans, context.tray.speed_unit, context.config))


STAGE = Stage(
    name="scorer",
    about="the band, and alarms on lasting excursions",
    reads=("prediction",),
    writes=("score", "alarm"),
    config=ScorerConfig,
    build=build,
)
