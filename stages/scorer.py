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
        """Take a residual (fans,); fans that are not valid keep their value. Returns the smoothed residual (fans,)."""
        keep = math.exp(-step_s / self._time_constant_s) if self._time_constant_s > 0 else 0.0
        before = np.where(np.isnan(self.smoothed), residual, self.smoothed)
        self.smoothed = np.where(valid, residual + keep * (before - residual), self.smoothed)
        return self.smoothed


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


@dataclass(frozen=True)
class Changes:
    """What one sample changed. All (fans,) of bool."""

    raised: Array
    cleared: Array
    too_short: Array


class AlarmStates:
    """The state of each fan: NORMAL, SUSPECT (on-delay runs), ALARM, RETURNING (off-delay runs). All arrays by fan."""

    def __init__(self, fans: int, on_delay_ns: int, off_delay_ns: int) -> None:
        self._on_delay_ns = on_delay_ns
        self._off_delay_ns = off_delay_ns
        self.state = np.full(fans, FanState.NORMAL, np.uint8)
        self.onset_t_ns = np.zeros(fans, np.int64)
        """First sample of the present excursion; meaningless when NORMAL."""
        self._lasted_ns = np.zeros(fans, np.int64)  # how long the condition of SUSPECT or RETURNING has held

    def update(self, t_ns: int, step_ns: int, exceeds: Array, returns: Array, valid: Array) -> Changes:
        """Take one sample. Fans that are not valid keep state and timers.

        exceeds, returns: whether the score is beyond the limit, or below the limit of return.
        """
        was = self.state
        normal, suspect = valid & (was == FanState.NORMAL), valid & (was == FanState.SUSPECT)
        alarm, returning = valid & (was == FanState.ALARM), valid & (was == FanState.RETURNING)
        begins = (normal & exceeds) | (alarm & returns)
        goes_on = (suspect & exceeds) | (returning & returns)
        self.onset_t_ns[normal & exceeds] = t_ns
        self._lasted_ns[begins] = 0
        self._lasted_ns[goes_on] += step_ns
        active = alarm | returning
        raised = (normal | suspect) & exceeds & (self._lasted_ns >= self._on_delay_ns)
        cleared = active & returns & (self._lasted_ns >= self._off_delay_ns)
        too_short = suspect & ~exceeds
        self.state = np.select(
            [raised, cleared, too_short, normal & exceeds, active & returns, active],
            [FanState.ALARM, FanState.NORMAL, FanState.NORMAL, FanState.SUSPECT, FanState.RETURNING, FanState.ALARM],
            default=was,
        ).astype(np.uint8)
        return Changes(raised, cleared, too_short)


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
        smoothed = np.empty_like(residual)
        state = np.empty(residual.shape, np.uint8)
        alarms: list[Alarm] = []
        for k, time_ns in enumerate(t_ns.tolist()):
            smoothed[k] = self._smoother.update(residual[k], valid[k], item.step_ns / NS_PER_S)
            alarms += self._judge(time_ns, item.step_ns, smoothed[k], valid[k], item.sigma_rad_s)
            state[k] = np.where(valid[k], self._states.state, FanState.UNKNOWN)
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
            state=state,
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

    def _judge(self, t_ns: int, step_ns: int, smoothed: Array, valid: Array, sigma: Array) -> list[Alarm]:
        limit, return_limit = self._threshold.limit(sigma), self._threshold.return_limit(sigma)
        size = np.abs(smoothed)
        changes = self._states.update(t_ns, step_ns, size > limit, size < return_limit, valid)
        self._counts["excursions_too_short"] += int(changes.too_short.sum())
        alarms = []
        for fan in np.flatnonzero(changes.raised | changes.cleared).tolist():
            raised = bool(changes.raised[fan])
            self._counts["alarms_raised" if raised else "alarms_cleared"] += 1
            residual, crossed = float(smoothed[fan]), float((limit if raised else return_limit)[fan])
            alarms.append(
                Alarm(
                    fan=fan,
                    active=raised,
                    severity=Severity.ALARM,
                    t_ns=t_ns,
                    onset_t_ns=int(self._states.onset_t_ns[fan]),
                    residual_rad_s=residual,
                    limit_rad_s=crossed,
                    message=self._raised(fan, residual, crossed) if raised else self._cleared(fan, crossed),
                )
            )
        return alarms

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
