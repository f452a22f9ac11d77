"""Scorer: compares the measurements with the twin, and maintains the alarm of each fan.

Reads: topic `prediction` (measured and predicted speed rad/s, torque balance in command units), and `request` (what
operators request about alarms).
Writes: topic `score` (residuals, baselines, the statistic closest to its limit, state), `alarm` (every transition of a
fan's alarm), `snapshot` (the state to continue from after a restart).
Timing: one score message for every prediction message, immediately; delays count the time of valid samples.

Four things are kept apart: the *statistics* on two residuals (scoring.fan_scorer), their *limits* (scoring.limits, from
the twin's card), the *state* of each alarm after OPC UA Part 9 (scoring.alarms.tray_conditions), and its *diagnosis*
(scoring.diagnosis.diagnosis). See docs/explanation/deciding.md.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from pipeline.runtime.decision_rules import CURRENT_RULES, DecisionRules
from pipeline.runtime.healthy_twin import HealthyTwin, ScorerConfig, healthy_twin
from pipeline.runtime.judged_share import JudgedShare
from pipeline.runtime.old_samples import OldSamples
from pipeline.runtime.snapshot_store import SnapshotStore
from pipeline.runtime.stage import BuiltStage, Context, Core, Stage, StageError
from pipeline.runtime.tray_twin import load_tray_twin, twin_path
from schemas.blocks import select
from schemas.messages import (
    Alarm,
    Array,
    FanState,
    Prediction,
    Request,
    Score,
    ScorerSnapshot,
    Transition,
)
from schemas.units import NS_PER_S, SpeedUnit
from scoring.alarms.alarm_manager import AlarmContext, AlarmManager
from scoring.alarms.alarm_text import AlarmText
from scoring.alarms.fan_condition import ALARM, RETURNING, ConditionSettings
from scoring.alarms.holding import holding_detectors
from scoring.alarms.tray_conditions import AlarmEvent
from scoring.alarms.unscored_monitor import UnscoredMonitor
from scoring.diagnosis.advice import Advice
from scoring.diagnosis.diagnoser import Diagnoser
from scoring.fan_scorer import HALF_LIMIT, FanScorer
from scoring.former_snapshot_keys import FORMER_SCORER_KEYS, current_keys
from scoring.samples import among, arrived, samples_of
from scoring.score_message import score_of
from scoring.scored_block import ScoredBlock
from scoring.snapshot_times import with_times_moved
from scoring.wear.followed import followed_fans
from scoring.wear.wear_monitor import WearMonitor

SNAPSHOT_PERIOD_NS = 60 * NS_PER_S  # between snapshots while nothing happens
SHOWN_NS = 60 * NS_PER_S  # how long health says that a snapshot was not used
NEW_START = "baselines, alarms and wear start from the beginning"
OPERATORS_KEPT = "shelved, suppressed and out of service are kept"
ANOTHER_TWIN = f"the snapshot is of another twin: {NEW_START}; {OPERATORS_KEPT}"
READ_IN_PART = f"the snapshot can be read in part only: {NEW_START}; {OPERATORS_KEPT}"
NOT_READ = f"the snapshot cannot be read: {NEW_START}, and nothing is shelved, suppressed or out of service"
RESTORE_ERRORS = (ValueError, LookupError, TypeError, AttributeError, OverflowError, RecursionError)
DATA_LOST_AFTER_NS = 2 * NS_PER_S  # an active alarm is not confirmed by data after so long without a score
SET_BACK_NS = NS_PER_S  # a snapshot further ahead of the present is of a clock that was set back since
BACK_IN_TIME_NS = 120 * NS_PER_S  # a restarted producer catches up with less; older samples are of another recording


class ScorerCore(Core):
    """The scorer of one tray. Fans do not affect one another."""

    def __init__(
        self,
        fans: int,
        speed_unit: SpeedUnit,
        config: ScorerConfig,
        twin: HealthyTwin,
        snapshot_store: SnapshotStore | None = None,
        decision_rules: DecisionRules = CURRENT_RULES,
        started_t_ns: int | None = None,
    ) -> None:
        """snapshot_store: where snapshots are kept; None: nowhere, as in a replay. started_t_ns: the present time."""
        self._fans = fans
        self._twin = twin
        self._config = config
        self._text = AlarmText(speed_unit, twin.command_unit)
        self._forgets_over_gaps = decision_rules >= DecisionRules.TIME_AND_GAPS
        self._holds = decision_rules >= DecisionRules.HOLDING
        self._judges_rest = decision_rules >= DecisionRules.AT_REST
        self._allows_for_counts = decision_rules >= DecisionRules.ONE_ALARM
        self._scorer = self._new_scorer()
        off_delay_s = config.least_off_delay_s(twin.tachos)
        holding = holding_detectors(self._scorer.detectors, off_delay_s, judges_rest=self._judges_rest)
        self._settings = ConditionSettings(
            on_delay_ns=round(twin.limits.timing.on_delay_s * NS_PER_S),
            off_delay_ns=round(off_delay_s * NS_PER_S),
            return_ratio=1.0 - config.deadband,
            alarm_ratio=config.alarm_ratio,
            latching=config.latching,
            confirming=config.confirming,
            data_lost_after_ns=DATA_LOST_AFTER_NS if self._forgets_over_gaps else None,
            settling_ns=self._scorer.longest_memory_ns,
            detectors=holding if self._holds else (),
        )
        self._unscored = UnscoredMonitor(fans, max(1, round(config.not_judged_s * NS_PER_S)))
        self._snapshot_store = snapshot_store
        self._wrong_fans = 0
        self._old_samples = OldSamples()
        self._judged_share = JudgedShare()
        self._counts: Counter[str] = Counter()
        self._not_restored = ""
        """why the snapshot was not used as a whole, for people"""
        self._set_back, self._set_back_until_t_ns = "", 0
        """that the snapshot was set back, for people"""
        self._start_new()
        snapshot = snapshot_store.load() if snapshot_store else None
        self._at_start = self.restore(snapshot) if snapshot else []
        """messages to be emitted first"""
        is_ahead = started_t_ns is not None and self._last_t_ns > started_t_ns + SET_BACK_NS
        self._may_be_set_back = is_ahead and self._is_restored and not self._not_restored
        """the snapshot is of later times than now: the first prediction shows whether all times have gone back"""

    def _start_new(self) -> None:
        self._sigma_rad_s = np.ones(self._fans)
        self._scorer = self._new_scorer()
        twin = self._twin
        advice = Advice(twin.command_unit) if self._holds else None
        if self._judges_rest:
            lowest_command = twin.standstill.turning_command if twin.standstill else 0.0
            advice = Advice(twin.command_unit, lowest_command, twin.highest_command)
        self._diagnoser = Diagnoser(
            twin.balances, advice, twin.tachos, twin.standstill, knows_readings=self._judges_rest
        )
        self._wear = WearMonitor(
            self._twin.balances, self._diagnoser, self._config.wear_every_s, self._twin.command_unit
        )
        self._alarms = AlarmManager(self._fans, self._settings, self._diagnoser, self._text)
        self._last_t_ns = self._snapshot_t_ns = np.iinfo(np.int64).min
        self._input_producer = ""
        """who made the last prediction"""
        self._is_restored = False
        """from a snapshot that was not yet compared with the first prediction"""

    def _new_scorer(self) -> FanScorer:
        return FanScorer(
            self._fans,
            self._twin.limits,
            tachos=self._twin.tachos,
            forgets_over_gaps=self._forgets_over_gaps,
            skips_transients=self._holds,
            allows_for_counts=self._allows_for_counts,
        )

    def restore(self, snapshot: ScorerSnapshot) -> list[Alarm | ScorerSnapshot]:
        """Continue from a snapshot. Returns the messages that report it.

        If it is of another twin, or its baselines or wear cannot be read, as after an update, only what belongs to
        operators is restored: shelved, suppressed, out of service, and the requests already answered.
        """
        try:
            state = current_keys(json.loads(snapshot.state_json), FORMER_SCORER_KEYS)
            self._alarms.restore(state["alarms"])
            input_producer = str(state["input_producer"])
        except RESTORE_ERRORS:
            self._start_new()
            self._counts["snapshots_not_understood"] += 1
            self._not_restored = NOT_READ
            return []
        if snapshot.twin_sha256 != self._twin.sha256:
            self._counts["snapshots_of_another_twin"] += 1
            self._not_restored = ANOTHER_TWIN
        else:
            try:
                if "wear" in state:
                    self._wear.restore(state["wear"])
                self._scorer.restore(state["scorer"])
            except RESTORE_ERRORS:
                self._start_new()
                self._alarms.restore(state["alarms"])
                self._counts["snapshots_not_understood"] += 1
                self._not_restored = READ_IN_PART
        self._last_t_ns = self._snapshot_t_ns = snapshot.t_ns
        self._input_producer, self._is_restored = input_producer, True
        if self._not_restored:
            return [replace(snapshot, restored=True), *self._alarms.discard_all(snapshot.t_ns, keep_silenced=True)]
        return [replace(snapshot, restored=True), *self._alarms.republish()]

    def tick(self, now_ns: int) -> list[Alarm | ScorerSnapshot]:
        """Emit once what was restored, also if it is then discarded: a replay restores it, too."""
        if self._may_be_set_back:
            return []
        at_start, self._at_start = self._at_start, []
        return at_start

    def step(self, item: Prediction | Request) -> list[Score | Alarm | ScorerSnapshot]:
        """Score a block and return its score and alarm transitions; or answer a request."""
        if isinstance(item, Request):
            self._may_be_set_back = False
            return [*self.tick(0), *self._answer(item)]
        if item.fans != self._fans:
            self._wrong_fans = item.fans
            self._counts["lost_wrong_fan_count"] += len(item.t_ns)
            return []
        self._wrong_fans = 0
        self._set_snapshot_back(item)
        before_score = [*self.tick(0), *self._discard_if_of_other_times(item)]
        before = np.maximum.accumulate(np.concatenate(([self._last_t_ns], item.t_ns)))[:-1]
        new = item.t_ns > before
        self._counts["repeated"] += int((~new).sum())
        if not new.any():
            if len(item.t_ns):
                self._old_samples.add(item.t_ns, item.period_ns, self._last_t_ns)
            return before_score
        self._old_samples.clear()
        self._last_t_ns, self._input_producer = int(item.t_ns[new][-1]), item.header.producer
        score, alarms = self._score(item if new.all() else select(item, new))
        return [*before_score, score, *alarms, *self._take_snapshot(at_once=bool(alarms))]

    def counters(self) -> Mapping[str, int]:
        """docs/explanation/deciding.md says what each counts."""
        of_alarms = {
            "alarms_raised": self._alarms.raised,
            "alarms_cleared": self._alarms.cleared,
            "excursions_too_short": self._alarms.too_short,
        }
        return {**self._counts, **of_alarms}

    def notes(self) -> list[str]:
        """Which share of the samples was judged, and why the others were not; fans that change slowly."""
        limit = self._twin.limits.speed.baseline.adaptation_limit_sigmas
        followed = followed_fans(self._scorer.residuals["speed"].baseline, limit, self._sigma_rad_s, self._text.units)
        return [*self._judged_share.notes, *self._wear.notices(), *followed]

    def problem(self) -> str:
        """What people should look at: input, snapshot, fans without a score, baselines at their limit, wear."""
        if self._wrong_fans:
            return f"predictions of {self._wrong_fans} fans, [[tray]] says fans = {self._fans}: correct one of them"
        origin_t_ns = self._scorer.origin_t_ns
        is_new = origin_t_ns is None or self._last_t_ns < origin_t_ns + SHOWN_NS
        problems = [
            self._not_restored if is_new else "",
            self._set_back if self._last_t_ns < self._set_back_until_t_ns else "",
            self._unscored.problem(),
            self._old_samples.problem("predictions", "scorer"),
        ]
        problems += [self._snapshot_store.problem] if self._snapshot_store else []
        held = np.flatnonzero(self._scorer.held_baselines)
        if len(held):
            names = ", ".join(map(str, held.tolist()))
            problems.append(
                f"the baseline of fan {names} is at its adaptation limit: inspect the fan, or commission it again"
            )
        problems.append(self._wear.problem(self._last_t_ns))
        return "; ".join(filter(None, problems))

    def close(self) -> list[ScorerSnapshot]:
        """The snapshot that the next session continues from."""
        snapshots = self._take_snapshot(at_once=True) if self._last_t_ns > np.iinfo(np.int64).min else []
        self.abort()
        return snapshots

    def abort(self) -> None:
        """Save nothing; another process may use the snapshot."""
        if self._snapshot_store:
            self._snapshot_store.unlock()

    def _set_snapshot_back(self, item: Prediction) -> None:
        """Move the restored snapshot to before the first prediction, if the host clock was set back after it.

        How long nothing was judged is not known: longer than the statistics remember. Only a snapshot that is also
        ahead of the host's time is moved. Otherwise a producer repeats what it has kept, or a recording is played.
        """
        if not self._may_be_set_back or not len(item.t_ns):
            return
        self._may_be_set_back = False
        first_t_ns, ahead_ns = int(item.t_ns[0]), self._last_t_ns - int(item.t_ns[0])
        if item.header.producer == self._input_producer or ahead_ns < 0:
            return
        t_ns = first_t_ns - item.period_ns - max(self._scorer.longest_memory_ns, DATA_LOST_AFTER_NS)
        state = with_times_moved(self._state(), t_ns - self._last_t_ns)
        self._start_new()
        self._at_start = self.restore(ScorerSnapshot(t_ns=t_ns, twin_sha256=self._twin.sha256, state_json=_json(state)))
        self._snapshot_t_ns = 0  # saved at once: a restart must not set back the same one again
        self._counts["snapshots_set_back"] += 1
        self._set_back_until_t_ns = first_t_ns + SHOWN_NS
        self._set_back = (
            f"the snapshot is {ahead_ns / NS_PER_S:.0f} s ahead of the samples, because the host clock was set back: "
            "baselines, alarms and wear continue, with their times set back as well"
        )

    def _discard_if_of_other_times(self, item: Prediction) -> list[Alarm]:
        """Discard a restored snapshot if it is of later times than the first prediction, as when another recording is
        played, or the same one again. Returns the messages on alarms that are discarded.
        """
        if not self._is_restored or not len(item.t_ns):
            return []
        self._is_restored = False
        if item.header.producer == self._input_producer:
            return []  # the producer of the last prediction still runs, and repeats what it has kept
        first_t_ns, origin_t_ns = int(item.t_ns[0]), self._scorer.origin_t_ns
        again = origin_t_ns is not None and first_t_ns <= origin_t_ns
        if not again and first_t_ns >= self._last_t_ns - BACK_IN_TIME_NS:
            return []
        discarded, self._not_restored = self._alarms.discard_all(first_t_ns, keep_silenced=False), ""
        self._start_new()
        self._counts["snapshots_of_other_times"] += 1
        return discarded

    def _score(self, item: Prediction) -> tuple[Score, list[Alarm]]:
        self._sigma_rad_s = item.sigma_rad_s
        scored, state, events = self._decide(item)
        valid = np.isfinite(scored.score)
        self._feed_diagnoser(item, scored)
        score = score_of(item, scored, state)
        self._unscored.update(item.period_ns, valid, score.invalid_reason)
        self._judged_share.add(valid, score.invalid_reason)
        self._feed_wear(item, scored, state)
        sigma_rad_s, sigma_command = item.sigma_rad_s, item.torque_balance_sigma_command

        def limits(row: int, fan: int) -> tuple[float, float]:
            of_speed, of_balance = self._limits_at(item, scored, row, int(scored.statistic[row, fan]))
            return float((of_speed * sigma_rad_s)[fan]), float((of_balance * sigma_command)[fan])

        context = AlarmContext(balance_command=scored.balance_smoothed * sigma_command, limits=limits)
        return score, self._alarms.emit(events, score, context)

    def _limits_at(
        self, item: Prediction, scored: ScoredBlock, row: int, statistic: int
    ) -> tuple[Array | float, Array | float]:
        """How far both residuals may be from their baselines, by the alarm's statistic; (fans,) or for all, sigma."""
        period_s = item.period_ns / NS_PER_S
        if not self._holds:
            return self._scorer.limit_sigmas("speed", period_s), self._scorer.limit_sigmas("balance", period_s)
        speed = item.measured_speed_rad_s[row]
        return (
            self._scorer.limit_at("speed", speed, statistic, period_s, scored.speed_learned_scale[row]),
            self._scorer.limit_at("balance", speed, statistic, period_s, scored.balance_learned_scale[row]),
        )

    def _decide(self, item: Prediction) -> tuple[ScoredBlock, Array, list[AlarmEvent]]:
        """The scores, the states (n, fans) and the alarms' events. While an alarm is active, baselines stay."""
        speed = np.where(np.isfinite(item.predicted_speed_rad_s), item.predicted_speed_rad_s, item.measured_speed_rad_s)
        events: list[AlarmEvent] = []
        scored, stretches = self._scorer.stretches(samples_of(item))
        state = np.empty(scored.score.shape, np.uint8)
        for rows in stretches:
            was_active = self._alarms.active
            score, judged = scored.score[rows], scored.judged[rows]
            ratio = np.where(judged & np.isnan(score), 0.0, score)
            state[rows], happened = self._alarms.update(
                item.t_ns[rows], item.period_ns, ratio, judged, scored.ratios[rows], speed[rows]
            )
            if self._holds:
                in_alarm = among(state[rows], ALARM, RETURNING).any(axis=0)
                self._scorer.learn_nothing(was_active | self._alarms.active | in_alarm)
            events += [replace(event, row=event.row + rows.start) for event in happened]
        return scored, state, events

    def _feed_diagnoser(self, item: Prediction, scored: ScoredBlock) -> None:
        command = item.averaged_command if len(item.averaged_command) else item.command
        expected = np.where(np.isfinite(item.measured_speed_rad_s), scored.balance_expected, np.nan)
        self._diagnoser.take(
            item.t_ns,
            item.period_ns,
            np.where(arrived(item.invalid_reason), command, np.nan),
            item.measured_speed_rad_s,
            scored.balance_baseline * item.torque_balance_sigma_command,
            scored.balance_baseline_s,
            expected * item.torque_balance_sigma_command,
            item.predicted_speed_rad_s,
            item.reading_missing,
        )

    def _feed_wear(self, item: Prediction, scored: ScoredBlock, state: Array) -> None:
        assert self._scorer.origin_t_ns is not None
        sigma_command, known = item.torque_balance_sigma_command, np.isfinite(item.torque_balance_command)
        normal, period_s = state == FanState.NORMAL, item.period_ns / NS_PER_S
        self._wear.update(
            item.t_ns,
            self._scorer.origin_t_ns,
            eligible=(scored.score < HALF_LIMIT) & normal & known,
            disturbed=(scored.score >= HALF_LIMIT) | ~(normal | (state == FanState.UNKNOWN)),
            commissioned_command=scored.balance_commissioned * sigma_command,
            shared_command=scored.balance_shared * sigma_command,
            held=scored.balance_at_limit,
            limit_command=self._scorer.persistent_limit_sigmas("balance", period_s) * sigma_command,
        )

    def _answer(self, request: Request) -> list[Alarm | ScorerSnapshot]:
        alarms = self._alarms.answer(request, max(self._last_t_ns, 0))
        if not alarms:
            self._counts["requests_repeated"] += 1
            return []
        commissioned = np.zeros(self._fans, np.bool_)
        commissioned[[alarm.fan for alarm in alarms if alarm.transition == Transition.COMMISSIONING]] = True
        self._scorer.recommission(commissioned)
        self._wear.forget(commissioned, self._last_t_ns)
        self._counts["requests"] += 1
        return [*alarms, *self._take_snapshot(at_once=True)]

    def _take_snapshot(self, *, at_once: bool) -> list[ScorerSnapshot]:
        """The state for a restart, at once or when the last snapshot is old enough."""
        if not at_once and self._last_t_ns - self._snapshot_t_ns < SNAPSHOT_PERIOD_NS:
            return []
        self._snapshot_t_ns = self._last_t_ns
        snapshot = ScorerSnapshot(
            t_ns=max(self._last_t_ns, 0), twin_sha256=self._twin.sha256, state_json=_json(self._state())
        )
        if self._snapshot_store:
            self._snapshot_store.save(snapshot)
        return [snapshot]

    def _state(self) -> dict[str, Any]:
        return {
            "scorer": self._scorer.snapshot(),
            "alarms": self._alarms.snapshot(),
            "wear": self._wear.snapshot(),
            "input_producer": self._input_producer,
        }


def _json(state: Mapping[str, Any]) -> str:
    return json.dumps(state, allow_nan=False)


def build(context: Context) -> BuiltStage:
    """The core of one tray.

    Raises:
        StageError: the tray names no twin, or one that cannot be used; the snapshot file cannot be read, or another
            process uses it.
    """
    tray = context.tray
    path = context.snapshot_folder / f"scorer-{tray.name}.snapshot" if context.snapshot_folder else None
    twin = healthy_twin(context, load_tray_twin(twin_path(context), tray.fans))
    store = SnapshotStore(path) if path else None
    if store:
        store.lock(f"site {context.site}")
    return BuiltStage(
        ScorerCore(
            tray.fans,
            tray.speed_unit,
            context.config,
            twin,
            store,
            decision_rules=context.decision_rules,
            started_t_ns=context.started_t_ns,
        )
    )


def check(context: Context) -> list[str]:
    """Why the scorer cannot run; the twin integrator reports a twin that cannot be loaded."""
    try:
        twin = load_tray_twin(twin_path(context), context.tray.fans)
    except StageError:
        return []
    try:
        healthy_twin(context, twin)
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
