"""Scorer: judges what was measured against the twin, and keeps each fan's alarm.

Reads: topic `prediction` (measured and predicted speed rad/s, torque balance in command units), and `request` (what
operators want of alarms).
Writes: topic `score` (residuals, baselines, the statistic furthest towards its limit, state), `alarm` (every transition
of a fan's alarm), `snapshot` (what a restart must not forget).
Timing: a score for every prediction, at once, block for block; delays count the valid samples' own time.

Four things, kept apart: the *statistics* on the two residuals (scoring.fan_scorer), their *limits* (scoring.limits,
from the
twin's card), the *state* of each alarm after OPC UA Part 9 (scoring.alarms.tray_alarms), its *diagnosis*
(scoring.diagnosis.diagnosis).
The +-2 sigma band is shown beside them and is no alarm. See docs/explanation/deciding.md.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from pydantic import Field, ValidationError

from pipeline.runtime.snapshot_store import SnapshotStore
from pipeline.runtime.stage import Context, Core, Parts, Stage, StageConfig, StageError
from pipeline.runtime.tray_twin import TrayTwin, load_tray_twin, twin_path
from schemas.blocks import select
from schemas.messages import (
    Alarm,
    Array,
    FanState,
    InvalidReason,
    Prediction,
    Request,
    Score,
    ScorerSnapshot,
    Transition,
)
from schemas.units import NS_PER_S, SpeedUnit
from scoring.alarms.alarm_manager import AlarmContext, AlarmManager
from scoring.alarms.alarm_state import ConditionSettings
from scoring.alarms.alarm_text import AlarmText
from scoring.alarms.unscored_monitor import UnscoredMonitor
from scoring.diagnosis.diagnoser import Diagnoser
from scoring.diagnosis.regression_window import HealthyBalance
from scoring.fan_scorer import QUIET, FanScorer, ScoredBlock, samples_of
from scoring.limits import Limits, Timing, uncalibrated
from scoring.wear.wear_monitor import WearMonitor

BAND_SIGMAS = 2.0
SNAPSHOT_PERIOD_NS = 60 * NS_PER_S  # how often it is noted when nothing happens
SET_ASIDE_NS = 60 * NS_PER_S  # so long it is told that something was
ALL_BUT_QUIET = "baselines, alarms and wear begin anew; what operators keep quiet stays so"
ANOTHER_TWIN = f"the twin is another one: {ALL_BUT_QUIET}"
IN_PART = f"what was remembered is understood in part: {ALL_BUT_QUIET}"
NOT_UNDERSTOOD = "what was remembered is not understood: baselines, alarms and wear begin anew, nothing is kept quiet"
RESTORE_ERRORS = (ValueError, LookupError, TypeError, AttributeError, OverflowError, RecursionError)
BACK_IN_TIME_NS = 120 * NS_PER_S  # who is restarted catches up with less; samples still older are another story


class ScorerConfig(StageConfig):
    """Section `[scorer]`. Times that are not given are those that the twin was calibrated with."""

    alarm_sigmas: float = Field(
        default=2.0,
        gt=0,
        description="limit on the smoothed speed residual of a twin that was not calibrated, in sigma",
    )
    limit_factor: float = Field(default=1.0, gt=0, description="on all limits; above 1: fewer alarms than declared")
    smoothing_s: float | None = Field(default=None, ge=0, description="time constant of the residuals' low-pass")
    baseline_s: float | None = Field(default=None, gt=0, description="how long commissioning takes at least")
    adaptation_s: float | None = Field(default=None, gt=0, description="time constant of the baseline in the long run")
    on_delay_s: float | None = Field(default=None, ge=0, description="how long a limit must be exceeded to raise")
    off_delay_s: float = Field(default=1.0, ge=0, description="how long a return must last to clear")
    deadband: float = Field(default=0.25, ge=0, lt=1, description="share of its limit below which a return begins")
    alarm_ratio: float = Field(default=1.5, ge=1, description="from so many limits on a warning is an alarm")
    latching: bool = Field(default=False, description="whether a cleared alarm stays until it is reset")
    confirming: bool = Field(default=False, description="whether an acknowledged alarm must be confirmed, too")
    wear_every_s: float = Field(default=600.0, gt=0, description="how often a fan's wear is looked at")
    not_judged_s: float = Field(
        default=10.0, gt=0, description="a fan that is not judged for so long is told; above twin_integrator.warm_up_s"
    )

    def timing(self, calibrated: Timing) -> Timing:
        """The times in force."""
        own = {name: getattr(self, name) for name in Timing.model_fields}
        return calibrated.model_copy(update={name: value for name, value in own.items() if value is not None})


@dataclass(frozen=True, eq=False)
class Healthy:
    """What the scorer knows of the twin. sha256: which one it is."""

    sha256: str
    limits: Limits
    balances: Sequence[HealthyBalance]
    command_unit: str = ""


class ScorerCore(Core):
    """One tray's fans, each judged for itself."""

    def __init__(
        self,
        fans: int,
        speed_unit: SpeedUnit,
        config: ScorerConfig,
        healthy: Healthy,
        snapshot_store: SnapshotStore | None = None,
    ) -> None:
        """snapshot_store: where to keep what must not be forgotten; None: nowhere, as in a replay."""
        self._fans = fans
        self._healthy = healthy
        self._config = config
        self._wording = AlarmText(speed_unit, healthy.command_unit)
        self._settings = ConditionSettings(
            on_delay_ns=round(healthy.limits.timing.on_delay_s * NS_PER_S),
            off_delay_ns=round(config.off_delay_s * NS_PER_S),
            return_ratio=1.0 - config.deadband,
            alarm_ratio=config.alarm_ratio,
            latching=config.latching,
            confirming=config.confirming,
        )
        self._unscored = UnscoredMonitor(fans, max(1, round(config.not_judged_s * NS_PER_S)))
        self._snapshot_store = snapshot_store
        self._wrong_fans = 0
        self._counts: Counter[str] = Counter()
        self._set_aside = ""
        """what was not gone on from"""
        self._begin()
        self._first: list[Alarm | ScorerSnapshot] = []
        snapshot = snapshot_store.load() if snapshot_store else None
        if snapshot is not None:
            self._first = [*self.restore(snapshot)]

    def _begin(self) -> None:
        self._judge = FanScorer(self._fans, self._healthy.limits)
        self._diagnoser = Diagnoser(self._healthy.balances)
        self._wear = WearMonitor(
            self._healthy.balances, self._diagnoser, self._config.wear_every_s, self._healthy.command_unit
        )
        self._alarms = AlarmManager(self._fans, self._settings, self._diagnoser, self._wording)
        self._last_t_ns = np.iinfo(np.int64).min
        self._noted_t_ns = np.iinfo(np.int64).min
        self._fed_by = ""  # who made the last prediction
        self._may_be_of_other_times = False

    def restore(self, snapshot: ScorerSnapshot) -> list[Alarm | ScorerSnapshot]:
        """Go on from what another session has kept. Gives what is to be told of it.

        Of another twin, or where the rest is not understood, as after an update, only what belongs to operators is
        taken: what they want quiet, and that they were answered.
        """
        try:
            state = json.loads(snapshot.state_json)
            self._alarms.restore(state["desk"])
            fed_by = str(state["fed_by"])
        except RESTORE_ERRORS:
            self._begin()
            self._counts["snapshots_not_understood"] += 1
            self._set_aside = NOT_UNDERSTOOD
            return []
        if snapshot.twin_sha256 != self._healthy.sha256:
            self._counts["snapshots_of_another_twin"] += 1
            self._set_aside = ANOTHER_TWIN
        else:
            try:
                if "wear" in state:
                    self._wear.restore(state["wear"])
                self._judge.restore(state["judge"])
            except RESTORE_ERRORS:
                self._begin()
                self._alarms.restore(state["desk"])
                self._counts["snapshots_not_understood"] += 1
                self._set_aside = IN_PART
        self._last_t_ns = self._noted_t_ns = snapshot.t_ns
        self._fed_by, self._may_be_of_other_times = fed_by, True
        told = (
            self._alarms.discard_all(snapshot.t_ns, keep_silenced=True) if self._set_aside else self._alarms.republish()
        )
        return [replace(snapshot, restored=True), *told]

    def tick(self, now_ns: int) -> list[Alarm | ScorerSnapshot]:
        """Say once what was remembered."""
        first, self._first = self._first, []
        return first

    def step(self, item: Prediction | Request) -> list[Score | Alarm | ScorerSnapshot]:
        """Judge a block: its score, and then what happened to alarms; or answer a request."""
        if isinstance(item, Request):
            return [*self.tick(0), *self._answer(item)]
        if item.fans != self._fans:
            self._wrong_fans = item.fans
            self._counts["lost_wrong_fan_count"] += len(item.t_ns)
            return []
        self._wrong_fans = 0
        disowned = self._look_back(item)
        before = np.maximum.accumulate(np.concatenate(([self._last_t_ns], item.t_ns)))[:-1]
        new = item.t_ns > before
        self._counts["repeated"] += int((~new).sum())
        if not new.any():
            return [*self.tick(0), *disowned]
        self._last_t_ns, self._fed_by = int(item.t_ns[new][-1]), item.header.producer
        score, alarms = self._judge_block(item if new.all() else select(item, new))
        return [*self.tick(0), *disowned, score, *alarms, *self._note(bool(alarms))]

    def counters(self) -> Mapping[str, int]:
        """docs/explanation/deciding.md says what each counts."""
        desk = self._alarms
        of_alarms = {
            "alarms_raised": desk.raised,
            "alarms_cleared": desk.cleared,
            "excursions_too_short": desk.too_short,
        }
        return {**self._counts, **of_alarms}

    def problem(self) -> str:
        """Predictions of another number of fans, fans that have not been judged for long, or that drift."""
        if self._wrong_fans:
            return f"predictions of {self._wrong_fans} fans, [[tray]] says fans = {self._fans}: correct one of them"
        began_t_ns = self._judge.origin_t_ns
        is_new = began_t_ns is None or self._last_t_ns < began_t_ns + SET_ASIDE_NS
        problems = [self._set_aside if is_new else "", self._unscored.problem()]
        problems += [self._snapshot_store.problem] if self._snapshot_store else []
        judged = [residual for residual in (self._judge.speed, self._judge.balance) if residual.is_judged]
        adrift = np.flatnonzero(np.any([residual.baseline.is_at_limit for residual in judged], axis=0))
        if len(adrift):
            names = ", ".join(map(str, adrift.tolist()))
            problems.append(f"the baseline of fan {names} may drift no further: look at the fan, or commission it anew")
        problems.append(self._wear.problem(self._last_t_ns))
        return "; ".join(filter(None, problems))

    def close(self) -> list[ScorerSnapshot]:
        """Note what is known for the next session."""
        return self._note(True) if self._last_t_ns > np.iinfo(np.int64).min else []

    def _look_back(self, item: Prediction) -> list[Alarm]:
        """What is remembered of later times is of another recording, or of the same one played again: begin anew, and
        say so of the alarms that stood."""
        if not self._may_be_of_other_times or not len(item.t_ns):
            return []
        self._may_be_of_other_times = False
        if item.header.producer == self._fed_by:
            return []  # who made the last one still keeps it, and some before it
        first_t_ns, began_t_ns = int(item.t_ns[0]), self._judge.origin_t_ns
        again = began_t_ns is not None and first_t_ns <= began_t_ns
        if not again and first_t_ns >= self._last_t_ns - BACK_IN_TIME_NS:
            return []
        disowned, self._set_aside = self._alarms.discard_all(first_t_ns, keep_silenced=False), ""
        self._begin()
        self._first = []
        self._counts["snapshots_of_other_times"] += 1
        return disowned

    def _judge_block(self, item: Prediction) -> tuple[Score, list[Alarm]]:
        t_ns, invalid_reason, command = item.t_ns, item.invalid_reason, item.command
        measured, predicted = item.measured_speed_rad_s, item.predicted_speed_rad_s
        sigma, sigma_command = item.sigma_rad_s, item.torque_balance_sigma_command
        residual = measured - predicted
        verdict = self._judge.update(samples_of(item))
        valid = np.isfinite(verdict.score)
        balance_baseline = verdict.balance_baseline * sigma_command
        told = np.where(np.isin(invalid_reason, (InvalidReason.GAP, InvalidReason.STALE)), np.nan, command)
        usual = np.where(np.isfinite(measured), verdict.balance_usual * sigma_command, np.nan)
        self._diagnoser.take(t_ns, item.period_ns, told, measured, balance_baseline, verdict.balance_baseline_s, usual)
        state, changes = self._alarms.update(t_ns, item.period_ns, verdict.score, valid)
        invalid_reason = np.where(
            valid,
            InvalidReason.NONE,
            np.where(invalid_reason == InvalidReason.NONE, InvalidReason.WARMING_UP, invalid_reason),
        )
        self._unscored.update(item.period_ns, valid, invalid_reason.astype(np.uint8))
        self._watch_wear(item, verdict, state)
        band = BAND_SIGMAS * sigma
        score = Score(
            fans=self._fans,
            period_ns=item.period_ns,
            t_ns=t_ns,
            command=command,
            measured_speed_rad_s=measured,
            predicted_speed_rad_s=predicted,
            lower_bound_rad_s=predicted - band,
            upper_bound_rad_s=predicted + band,
            band_variance=np.broadcast_to(band**2, residual.shape),
            residual_rad_s=residual,
            smoothed_residual_rad_s=verdict.speed_smoothed * sigma,
            outside=np.abs(residual) > band,
            state=np.where(verdict.commissioning & ~valid, int(FanState.COMMISSIONING), state).astype(np.uint8),
            valid=valid,
            invalid_reason=invalid_reason.astype(np.uint8),
            torque_balance_command=item.torque_balance_command,
            speed_baseline_rad_s=verdict.speed_baseline * sigma,
            balance_baseline_command=balance_baseline,
            score=verdict.score,
            statistic=verdict.statistic,
        )
        return score, self._alarms.emit(
            changes, score, self._distance(verdict, item.period_ns / NS_PER_S, sigma, sigma_command)
        )

    def _watch_wear(self, item: Prediction, verdict: ScoredBlock, state: Array) -> None:
        assert self._judge.origin_t_ns is not None
        sigma_command, known = item.torque_balance_sigma_command, np.isfinite(item.torque_balance_command)
        normal = state == FanState.NORMAL
        self._wear.update(
            item.t_ns,
            self._judge.origin_t_ns,
            eligible=(verdict.score < QUIET) & normal & known,
            disturbed=(verdict.score >= QUIET) | ~(normal | (state == FanState.UNKNOWN)),
            commissioned_command=verdict.balance_commissioned * sigma_command,
            held=verdict.balance_held,
            limit_command=self._judge.balance.lasting_limit_sigmas(item.period_ns / NS_PER_S) * sigma_command,
        )

    def _distance(self, verdict: ScoredBlock, step_s: float, sigma: Array, sigma_command: Array) -> AlarmContext:
        return AlarmContext(
            balance_command=verdict.balance_smoothed * sigma_command,
            limit_rad_s=self._judge.speed.limit_sigmas(step_s) * sigma,
            balance_limit_command=self._judge.balance.limit_sigmas(step_s) * sigma_command,
        )

    def _answer(self, request: Request) -> list[Alarm | ScorerSnapshot]:
        told = self._alarms.answer(request, max(self._last_t_ns, 0))
        if not told:
            self._counts["requests_repeated"] += 1
            return []
        again = np.zeros(self._fans, np.bool_)
        again[[alarm.fan for alarm in told if alarm.transition == Transition.COMMISSIONING]] = True
        self._judge.forget(again)
        self._wear.forget(again, self._last_t_ns)
        self._counts["requests"] += 1
        return [*told, *self._note(True)]

    def _note(self, at_once: bool) -> list[ScorerSnapshot]:
        """What must not be forgotten: when something happened, and now and then."""
        if not at_once and self._last_t_ns - self._noted_t_ns < SNAPSHOT_PERIOD_NS:
            return []
        self._noted_t_ns = self._last_t_ns
        state = {
            "judge": self._judge.snapshot(),
            "desk": self._alarms.snapshot(),
            "wear": self._wear.snapshot(),
            "fed_by": self._fed_by,
        }
        snapshot = ScorerSnapshot(
            t_ns=max(self._last_t_ns, 0),
            twin_sha256=self._healthy.sha256,
            state_json=json.dumps(state, allow_nan=False),
        )
        if self._snapshot_store:
            self._snapshot_store.save(snapshot)
        return [snapshot]


def build(context: Context) -> Parts:
    """The core of one tray.

    Raises:
        StageError: the tray names no twin, or one that cannot be used; what an earlier session kept cannot be read.
    """
    tray = context.tray
    snapshot_store = (
        SnapshotStore(context.snapshot_folder / f"scorer-{tray.name}.snapshot") if context.snapshot_folder else None
    )
    healthy = _healthy(context, load_tray_twin(twin_path(context), tray.fans))
    return Parts(ScorerCore(tray.fans, tray.speed_unit, context.config, healthy, snapshot_store))


def limits_in_force(config: ScorerConfig, calibration: Mapping[str, Any] | None) -> Limits:
    """The limits of a twin's card, or those of a twin that was not calibrated, as the settings change them.

    Raises:
        ValidationError: the calibration is none.
    """
    if calibration is None:
        return uncalibrated(config.alarm_sigmas, config.timing(Timing())).times(config.limit_factor)
    limits = Limits.model_validate(calibration)
    timing = config.timing(limits.timing)
    promise = limits.promise if timing == limits.timing else None  # it was for the other times
    return limits.model_copy(update={"timing": timing, "promise": promise}).times(config.limit_factor)


def _healthy(context: Context, twin: TrayTwin) -> Healthy:
    try:
        limits = limits_in_force(context.config, twin.card.calibration)
    except ValidationError as error:
        where = ".".join(map(str, error.errors()[0]["loc"]))
        raise StageError(
            f"{context.tray.twin}: its calibration cannot be used: {where}: {error.errors()[0]['msg']}; "
            "calibrate it anew: fantwin calibrate"
        ) from error
    for part in (limits.speed, limits.balance):
        if part.fans is not None and len(part.fans.offset_sigmas) != context.tray.fans:
            raise StageError(
                f"{context.tray.twin}: its calibration is of {len(part.fans.offset_sigmas)} fans, the tray has "
                f"{context.tray.fans}; calibrate it anew: fantwin calibrate"
            )
    return Healthy(twin.sha256, limits, twin.healthy_balances(), twin.card.command_unit)


def check(context: Context) -> list[str]:
    """What keeps the scorer from judging; of a twin that cannot be loaded the twin integrator tells."""
    try:
        twin = load_tray_twin(twin_path(context), context.tray.fans)
    except StageError:
        return []
    try:
        _healthy(context, twin)
    except StageError as error:
        return [str(error)]
    return []


STAGE = Stage(
    name="scorer",
    about="two residuals, their statistics, and the fans' alarms",
    reads=("prediction", "request"),
    writes=("score", "alarm", "snapshot"),
    config=ScorerConfig,
    build=build,
    check=check,
)
