"""How one tray is scored: a block of predictions in, its scores and the messages on alarms out.

Four things are kept apart: the *statistics* on two residuals (scoring.fan_scorer), their *limits* (scoring.limits, from
the twin's card), the *state* of each alarm after OPC UA Part 9 (scoring.alarms.tray_conditions), and its *diagnosis*
(scoring.diagnosis.diagnosis). They are built and connected here, with slow wear (scoring.wear) beside them.
See docs/explanation/deciding.md.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from pipeline.runtime.healthy_twin import HealthyTwin, ScorerConfig
from schemas.messages import Alarm, Array, Prediction, Score
from schemas.side_by_side import present_columns
from schemas.units import NS_PER_S
from scoring.alarms.alarm_manager import AlarmContext, AlarmManager
from scoring.alarms.alarm_text import AlarmText
from scoring.alarms.fan_condition import ALARM, NORMAL, RETURNING, ConditionSettings
from scoring.alarms.holding import holding_detectors
from scoring.alarms.tray_conditions import UNKNOWN, AlarmEvent
from scoring.diagnosis.advice import Advice
from scoring.diagnosis.diagnoser import Diagnoser
from scoring.fan_scorer import FanScorer
from scoring.interval_scorer import HALF_LIMIT
from scoring.samples import Samples, among, arrived, samples_of
from scoring.score_message import score_of
from scoring.scored_block import ScoredBlock
from scoring.wear.followed import followed_fans, shared_by_all
from scoring.wear.reference import healthy_fans
from scoring.wear.wear_monitor import WearInputs, WearMonitor


class TrayScorer:
    """The scores, alarms and wear of one tray's fans."""

    def __init__(self, fans: int, text: AlarmText, config: ScorerConfig, twin: HealthyTwin) -> None:
        """From the beginning: no fan is commissioned, and none has an alarm."""
        self.fans, self.twin = fans, twin
        self._text = text
        self._sigma_rad_s = np.ones(fans)
        self.fan_scorer = FanScorer(fans, twin.limits, tachos=twin.tachos)
        lowest_command = twin.standstill.turning_command if twin.standstill else 0.0
        self._diagnoser = Diagnoser(
            twin.balances,
            Advice(twin.command_unit, lowest_command, twin.highest_command),
            twin.tachos,
            twin.standstill,
            knows_supply=twin.knows_supply,
        )
        healthy = healthy_fans(twin.balances, twin.limits.balance)
        self.wear = WearMonitor(healthy, self._diagnoser, config.wear_every_s, twin.command_unit)
        off_delay_s = config.least_off_delay_s(twin.tachos)
        settings = ConditionSettings(
            on_delay_ns=round(twin.limits.timing.on_delay_s * NS_PER_S),
            return_ratio=1.0 - config.deadband,
            alarm_ratio=config.alarm_ratio,
            latching=config.latching,
            confirming=config.confirming,
            settling_ns=self.fan_scorer.longest_memory_ns,
            detectors=holding_detectors(self.fan_scorer.detectors, off_delay_s),
        )
        self.alarms = AlarmManager(fans, settings, self._diagnoser, text)

    def score(self, item: Prediction) -> tuple[Score, list[Alarm]]:
        """The score of a block of new samples, and the messages on alarms."""
        samples = samples_of(item, self.twin.unseen_error)
        scored, stretches = self.fan_scorer.stretches(samples, lambda: self.alarms.is_quiet)
        state, events = self.decide(item, scored, stretches)
        score = score_of(item, scored, state, samples.speed_unseen)
        return score, self.finish(item, samples, scored, state, events, score)

    def joint_key(self, item: Prediction) -> Hashable:
        """Blocks of trays with equal keys can be scored in one pass (pipeline.runtime.joint_tray_scorer). None: this
        one alone, see FanScorer.is_interval_over; or the tray has one fan, whose column NumPy adds up in another order
        than columns side by side."""
        is_over = self.fan_scorer.is_interval_over(item.t_ns)
        has_steps = bool((np.diff(item.t_ns) == item.period_ns).all())
        if is_over is None or not has_steps or self.fans == 1:
            return None
        return self.twin.sha256, self.fans, item.period_ns, len(item.t_ns), is_over, *present_columns(item)

    def finish(
        self,
        item: Prediction,
        samples: Samples,
        scored: ScoredBlock,
        state: Array,
        events: list[AlarmEvent],
        score: Score,
    ) -> list[Alarm]:
        """The messages on alarms of a block that has been decided."""
        self._sigma_rad_s = item.sigma_rad_s
        self._feed_diagnoser(item, scored)
        self._feed_wear(item, scored, state)
        sigma_rad_s, sigma_command = item.sigma_rad_s, item.torque_balance_sigma_command

        def limits(row: int, fan: int) -> tuple[float, float]:
            of_speed, of_balance = self._limits_at(item, samples, scored, row, int(scored.statistic[row, fan]))
            return float((of_speed * sigma_rad_s)[fan]), float((of_balance * sigma_command)[fan])

        context = AlarmContext(balance_command=scored.balance_smoothed * sigma_command, limits=limits)
        return self.alarms.emit(events, score, context)

    @property
    def followed(self) -> list[str]:
        """A line for what most fans share, if it is much, and for each fan whose baseline has followed it far."""
        healthy, residual = self.twin.limits.speed, self.fan_scorer.residuals["speed"]
        limit, units = healthy.baseline.adaptation_limit_sigmas, self._text.units
        of_each = followed_fans(residual.baseline, limit, self._sigma_rad_s, units)
        return [*shared_by_all(residual.shared_offset, healthy.shared_limit), *of_each]

    def recommission(self, fans: Array, t_ns: int) -> None:
        """Commission some fans again, (fans,) of bool, after the sample at t_ns."""
        self.fan_scorer.recommission(fans)
        self.wear.forget(fans, t_ns)

    def snapshot(self) -> dict[str, Any]:
        """The state to continue from, as JSON values."""
        return {
            "scorer": self.fan_scorer.snapshot(),
            "alarms": self.alarms.snapshot(),
            "wear": self.wear.snapshot(),
        }

    def restore_baselines(self, state: Mapping[str, Any]) -> None:
        """Restore what was learned, of a snapshot of the same twin: all but the alarms.

        Raises:
            ValueError, LookupError, TypeError, AttributeError, OverflowError, RecursionError: it cannot be read. Then
                a part may have been restored.
        """
        self.wear.restore(state["wear"])
        self.fan_scorer.restore(state["scorer"])

    def _limits_at(
        self, item: Prediction, samples: Samples, scored: ScoredBlock, row: int, statistic: int
    ) -> tuple[Array, Array]:
        """Limits of both residuals from their baselines, by the alarm's statistic: (fans,) each, in sigma."""
        period_s = item.period_ns / NS_PER_S
        limits, limit_at = self.fan_scorer.limits, self.fan_scorer.limit_at
        speed = samples.operating_speed_rad_s(is_predicted=limits.over_predicted_speed)[row]
        of_speed, of_balance = scored.speed_learned_scale[row], scored.balance_learned_scale[row]
        return (
            limit_at("speed", speed, statistic, period_s, of_speed, samples.speed_unseen[row]),
            limit_at("balance", speed, statistic, period_s, of_balance, samples.balance_unseen[row]),
        )

    def decide(
        self, item: Prediction, scored: ScoredBlock, stretches: Iterable[slice]
    ) -> tuple[Array, list[AlarmEvent]]:
        """The states (n, fans) and the alarms' events. While an alarm is active, baselines stay.

        stretches: the rows that are scored, one stretch after the other.
        """
        speed = np.where(np.isfinite(item.predicted_speed_rad_s), item.predicted_speed_rad_s, item.measured_speed_rad_s)
        events: list[AlarmEvent] = []
        state = np.empty(scored.score.shape, np.uint8)
        for rows in stretches:
            was_active = self.alarms.active
            score, judged = scored.score[rows], scored.judged[rows]
            ratio = np.where(judged & np.isnan(score), 0.0, score)
            state[rows], happened = self.alarms.update(
                item.t_ns[rows], item.period_ns, ratio, judged, scored.ratios[rows], speed[rows]
            )
            in_alarm = among(state[rows], ALARM, RETURNING).any(axis=0)
            self.fan_scorer.learn_nothing(was_active | self.alarms.active | in_alarm)
            events += [replace(event, row=event.row + rows.start) for event in happened]
        return state, events

    def _feed_diagnoser(self, item: Prediction, scored: ScoredBlock) -> None:
        command = item.averaged_command if len(item.averaged_command) else item.command
        is_known = arrived(item.invalid_reason)
        is_converted = self.twin.knows_supply or len(item.air_density_ratio) > 0
        expected = np.where(np.isfinite(item.measured_speed_rad_s), scored.balance_expected, np.nan)
        density = item.air_density_ratio if len(item.air_density_ratio) else 1.0
        self._diagnoser.take(
            item.t_ns,
            item.period_ns,
            np.where(is_known, command, np.nan),
            item.measured_speed_rad_s * density,  # at the twin's reference, as the command and the balance are
            scored.balance_baseline * item.torque_balance_sigma_command,
            scored.balance_baseline_s,
            expected * item.torque_balance_sigma_command,
            item.predicted_speed_rad_s * density,
            item.reading_missing,
            item.supply_voltage_v,
            item.current_a,
            np.where(is_known, item.command, np.nan) if is_converted else np.zeros(0),
        )

    def _feed_wear(self, item: Prediction, scored: ScoredBlock, state: Array) -> None:
        assert self.fan_scorer.origin_t_ns is not None
        normal = state == NORMAL

        def inputs() -> WearInputs:
            sigma_command = item.torque_balance_sigma_command
            limit_sigmas = self.fan_scorer.persistent_limit_sigmas("balance", item.period_ns / NS_PER_S)
            return WearInputs(
                eligible=(scored.score < HALF_LIMIT) & normal & np.isfinite(item.torque_balance_command),
                commissioned_command=scored.balance_commissioned * sigma_command,
                shared_command=scored.balance_shared * sigma_command,
                held=scored.balance_at_limit,
                limit_command=limit_sigmas * sigma_command,
            )

        disturbed = (scored.score >= HALF_LIMIT) | ~(normal | (state == UNKNOWN))
        self.wear.update(item.t_ns, self.fan_scorer.origin_t_ns, disturbed, inputs)
