"""How one tray is scored: a block of predictions in, its scores and the messages on alarms out.

Samples become bins (scoring.model.bins). At the end of each, the model of a healthy fan and the evidence for its faults
are brought up to date (scoring.model.decision), fans that stand or turn against their command are looked for
(scoring.as_commanded), and so is slow wear (scoring.wear). Whatever is wrong becomes one alarm of the fan, with a state
after OPC UA Part 9 (scoring.alarms) and causes (scoring.diagnosis). They are built and connected here.
See docs/explanation/deciding.md.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from fantwin.pipeline.tray_scoring.healthy_twin import HealthyTwin
from fantwin.pipeline.tray_scoring.scorer_config import ScorerConfig
from fantwin.pipeline.tray_scoring.scorer_state import ScorerState
from fantwin.schemas.enums import InvalidReason, Severity, Statistic
from fantwin.schemas.messages import Alarm, Array, Diagnosis, Prediction, Score
from fantwin.schemas.units import NS_PER_S
from fantwin.scoring.alarms.alarm_manager import AlarmManager, Measured
from fantwin.scoring.alarms.alarm_text import AlarmText
from fantwin.scoring.alarms.alarms_of_tray import Decided
from fantwin.scoring.alarms.unscored_monitor import REASONS
from fantwin.scoring.as_commanded.against_command import KINDS, AgainstCommand
from fantwin.scoring.as_commanded.stands_still import Falls
from fantwin.scoring.diagnosis.causes import CANNOT_TELL, CAUSES, SENSOR_DROPOUT, SLOW_CHANGE, is_of_standstill
from fantwin.scoring.diagnosis.ranked_causes import KNOWN_SOON, CauseWords, PossibleCause, SeenSinceOnset
from fantwin.scoring.diagnosis.standstill_causes import Standing, standstill_causes
from fantwin.scoring.model.bins import Bin, Bins, bin_ns_of
from fantwin.scoring.model.decision import Decision
from fantwin.scoring.samples import IDLE, among, arrived
from fantwin.scoring.saved import Saved, part
from fantwin.scoring.score_message import ScoreColumns, score_of
from fantwin.scoring.wear.wear_monitor import WearMonitor

SMALLEST_SHARE = 0.0005  # smaller ones are not named


class JudgedShare:
    """Counts the samples of one tray's fans since the start of a session: the share scored, and why others were not."""

    def __init__(self) -> None:
        self._judged = 0
        self._not_judged = np.zeros(256, np.int64)
        """by reason"""

    def add(self, valid: Array, invalid_reason: Array) -> None:
        """Add the samples of a block. valid, invalid_reason: (n, fans)."""
        judged = int(np.count_nonzero(valid))
        self._judged += judged
        if judged < valid.size:
            self._not_judged += np.bincount(invalid_reason[~valid], minlength=256)

    @property
    def notes(self) -> list[str]:
        """One line; none before the first sample."""
        samples = self._judged + int(self._not_judged.sum())
        if not samples:
            return []
        reasons = [
            f"{100 * count / samples:.1f} % {REASONS.get(InvalidReason(reason), InvalidReason(reason).words)}"
            for reason, count in sorted(enumerate(self._not_judged.tolist()), key=lambda found: -found[1])
            if count >= SMALLEST_SHARE * samples
        ]
        because = f"; not judged: {', '.join(reasons)}" if reasons else ""
        return [f"{100 * self._judged / samples:.1f} % of the fans' samples judged{because}"]


WEAR_EVERY_S = 600.0
"""between two points of the wear of a fan, which takes days to months"""
NO_READING = KINDS.index(Standing.NO_READING)
NAMED_AFTER_S, FALLING_S = 3.0, 4.0
"""age of an onset from which a cause is named; time after an alarm in which a fan that lost much speed may stop"""


class TrayScorer(Saved):
    """The scores, alarms and wear of one tray's fans. What it tells of a fan is that of the end of the last bin."""

    KEPT = (
        *("_period_ns", "_decision", "_bins", "_falls", "_against", "_now", "wear"),
        *("_seen", "_command", "_kind", "_stands"),
    )

    def __init__(self, fans: int, text: AlarmText, config: ScorerConfig, twin: HealthyTwin) -> None:
        """Begin with fans of which nothing is known but their twin, and without an alarm."""
        self.fans, self.twin = fans, twin
        self._alarm_share = config.alarm_share
        self._words = CauseWords(twin.advice, has_supply=twin.has_supply)
        self.wear = WearMonitor(fans, WEAR_EVERY_S, text.names)
        self._against = AgainstCommand(twin.standstill, twin.tachos) if twin.standstill else None
        self.alarms = AlarmManager(fans, text)
        self._names = text.names
        self._period_ns = 0
        self._open(NS_PER_S)
        self._period_ns = 0  # of no sample yet
        self._stands = np.zeros(fans, np.bool_)
        """(fans,) against its command"""
        self._kind = np.zeros(fans, np.int64)
        """(fans,) what it does against its command, number in KINDS"""
        self._seen = np.full((4, fans), np.nan)
        """(4, fans) lowest and highest speed, lowest and highest command since an alarm was raised; NaN: not known"""
        self._command = np.zeros(fans)
        """(fans,) newest command"""
        self._now = ScoreColumns.empty(fans)

    def _open(self, period_ns: int) -> None:
        """Begin with samples of this period; what was learned of the fans goes on."""
        twin, before = self.twin, self._decision if self._period_ns else None
        bin_ns = bin_ns_of(period_ns, float(twin.fans.held_s.min()))
        self._period_ns = period_ns
        self._bins = Bins(bin_ns, twin.fans.top_rad_s, twin.fans.reads_balance, twin.unseen_error)
        period_s = period_ns / NS_PER_S
        self._decision = Decision(twin.fans, bin_ns, period_s, twin.declared_s, twin.priors, twin.limit_factor)
        self._falls = Falls(twin.fans, self._decision.bin_s)
        if before is not None:
            self._decision.go_on_from(before)

    def score(self, item: Prediction) -> tuple[Score, list[Alarm]]:
        """The score of a block of new samples, and the messages on alarms."""
        if item.period_ns != self._period_ns:
            self._open(item.period_ns)
        if self._against:
            self._against.take(item)
        columns = ScoreColumns.empty(len(item.t_ns), self.fans)
        alarms: list[Alarm] = []
        begin = 0
        for one in self._bins.take(item):
            columns.fill(slice(begin, one.row), self._now)
            begin = one.row
            alarms += self._decide(one, item)
        columns.fill(slice(begin, len(item.t_ns)), self._now)
        return score_of(item, columns, self.twin.fans.reads_balance, self._bins.unseen_rad_s), alarms

    def notices(self) -> list[str]:
        """Notes on fans that change slowly, and on tachos that are not sound."""
        many = self._decision.wrong.many
        unsound = [
            f"{self._names.label(fan)}: {many[fan]:.0%} of the readings of its tacho are wrong: check the tacho and "
            "its wire"
            for fan in np.flatnonzero(many).tolist()
        ]
        return [*self.wear.notices(), *unsound]

    def recommission(self, fans: Array, t_ns: int) -> None:
        """Forget what was learned of some fans, (fans,) of bool, after the sample at t_ns."""
        if fans.any():
            self._decision.begin_again(fans)
            self.alarms.state.commissioned += np.flatnonzero(fans).tolist()
            self.wear.forget(fans, t_ns)
            if self._against:
                self._against.forget(fans)

    def statistic(self, fan: int) -> Statistic:
        """See FanFacts."""
        return Statistic(int(self._now.statistic[fan]))

    def measured(self, fan: int) -> Measured:
        """See FanFacts."""
        decision = self._decision
        residual, std = float(decision.deviation_rad_s[fan]), float(decision.deviation_std_rad_s[fan])
        statistic = self.statistic(fan)
        speed = float(decision.now.speed_rad_s[fan]) if decision.now else 0.0
        slow = self.wear.of(fan)
        if statistic == Statistic.WEAR and slow:
            residual, std = slow.change * speed, slow.std_error * speed
        torque = float(self.twin.fans.slope(np.full(self.fans, speed))[fan]) if decision.in_balance[fan] else 0.0
        as_speed = 0.0 if decision.in_balance[fan] else 1.0
        return Measured(
            residual_rad_s=as_speed * residual,
            residual_std_rad_s=as_speed * std,
            torque_balance_command=-torque * residual,
            torque_balance_std_command=torque * std,
            statistic=statistic,
            score=float(np.nan_to_num(self._now.score[fan])),
        )

    def causes(self, fan: int, known: tuple[Diagnosis, ...] = ()) -> tuple[Diagnosis, ...]:
        """See FanFacts."""
        decision, falls, command = self._decision, self._falls, float(self._command[fan])
        kind = KINDS[self._kind[fan]]
        if kind == Standing.NOT_STARTED and known and is_of_standstill(known[0]):
            return known  # how it came to rest says more than that it does not start
        if self._stands[fan] and kind is not None:
            fall = falls.of(fan) if kind == Standing.CAME_TO_REST and falls.is_falling[fan] else None
            return standstill_causes(kind, fall, command)
        if decision.active[fan]:
            return self._causes_of_deviation(fan, command)
        words, seen, fan_of_twin = self._words, self._seen_since(fan), self.twin.steady_fans[fan]
        if decision.missing.is_active[fan]:
            dropout = PossibleCause(SENSOR_DROPOUT, 1.0, float(decision.missing.share[fan]), np.nan)
            return words.of([dropout], seen, fan_of_twin)
        slow = self.wear.of(fan)
        if slow and self.wear.is_over[fan]:
            return words.of([PossibleCause(SLOW_CHANGE, 1.0, slow.change, slow.std_error)], seen, fan_of_twin)
        return ()

    @property
    def stands_against_command(self) -> Array:
        """See FanFacts."""
        return self._stands | (self._decision.active & self._has_stopped)

    @property
    def _has_stopped(self) -> Array:
        """Return where a fan stands, (fans,), by readings that may not be wrong."""
        return self._falls.stands & ~self._decision.wrong.may_be

    def _causes_of_deviation(self, fan: int, command: float) -> tuple[Diagnosis, ...]:
        decision, falls = self._decision, self._falls
        if self._has_stopped[fan]:
            return standstill_causes(Standing.CAME_TO_REST, falls.of(fan), command)
        causes = decision.alarms.causes(fan)
        if not causes:  # it is of before a gap
            return ()
        age_s = decision.alarms.age_s(fan)
        is_new = decision.raised_s(fan) < FALLING_S
        if age_s < NAMED_AFTER_S or (is_new and falls.is_falling[fan]):
            return (Diagnosis(cause=CANNOT_TELL, probability=1.0, evidence=f"{CAUSES[CANNOT_TELL]}: {KNOWN_SOON}"),)
        return self._words.of(causes, self._seen_since(fan), self.twin.steady_fans[fan])

    def _seen_since(self, fan: int) -> SeenSinceOnset:
        return SeenSinceOnset(*self._seen[:, fan].tolist())

    def _decide(self, one: Bin, item: Prediction) -> list[Alarm]:
        """Bring all up to date with the end of a bin; returns the messages on alarms."""
        decision, against, row = self._decision, self._against, one.row
        gap_s = (one.t_ns - decision.operation.t_ns) / NS_PER_S - decision.bin_s
        decision.take(one)
        assert decision.now is not None
        if gap_s > 0.0:
            self._falls.rest(gap_s)
        self._falls.take(decision.now)
        if against:
            is_now = against.kind[row] > 0
            self._kind = np.where(is_now, against.kind[row], self._kind)
            is_loose = (self._kind == NO_READING) & decision.missing.explains_silence
            may_be_wrong = decision.wrong.may_be & one.judged  # of the last reading that was compared with the twin
            self._stands = against.active[row] & ~is_loose & (self._stands | (is_now & ~may_be_wrong))
        score = decision.score
        is_steady = one.judged & ~self._stands & ~decision.has_alarm & (score < ScoreColumns.SUSPECT_FROM)
        self.wear.update(one.t_ns, is_steady, lambda: decision.model.age)
        is_worn = self.wear.is_over
        active = decision.has_alarm | self._stands | is_worn
        idle = among(item.invalid_reason[row], *IDLE)
        is_silent = (decision.missing.is_active | self._stands) & arrived(item.invalid_reason[row])
        judged = one.judged | idle | is_silent
        judged[self.alarms.state.commissioned] = True
        self.alarms.state.commissioned = []
        self._see(one, self.alarms.active)
        self._now = self._columns(score, active, is_worn, against.score[row] if against else np.zeros(self.fans))
        is_large = self._stands | (np.abs(decision.fault[0]) >= self._alarm_share)
        bins_since_onset = np.where(decision.active, decision.number - decision.onset + 1, 1)
        decided = Decided(
            min(one.t_ns, int(item.t_ns[row])),  # a bin ends with its last sample, which is before its end
            judged,
            active,
            np.where(is_large, int(Severity.ALARM), int(Severity.WARNING)),
            one.t_ns - bins_since_onset * round(decision.bin_s * NS_PER_S),
            round(decision.bin_s * NS_PER_S),
        )
        return self.alarms.update(decided, self)

    def _columns(self, score: Array, active: Array, is_worn: Array, against: Array) -> ScoreColumns:
        """What the score message says of the fans until the end of the next bin."""
        decision = self._decision
        assert decision.now is not None
        expected = decision.model.expected_rad_s
        missing = decision.missing
        is_missing = ~decision.active & (missing.is_active | (missing.score > decision.deviation_score))
        statistic = np.where(is_missing, int(Statistic.MISSING_READINGS), int(Statistic.DEVIATION))
        statistic = np.where(is_worn & ~decision.has_alarm, int(Statistic.WEAR), statistic)
        statistic = np.where(self._stands, int(Statistic.STANDSTILL), statistic)
        return ScoreColumns(
            score=np.maximum(score, np.where(self._stands, against.clip(1.0), 0.0)),
            statistic=statistic.astype(np.uint8),
            is_active=active,
            is_returning=active & ~self._stands & ~is_worn & ~decision.missing.is_active & decision.is_returning,
            expected_residual_rad_s=expected,
            expected_balance_command=-expected * self.twin.fans.slope(decision.now.speed_rad_s),
        )

    def _see(self, one: Bin, was_active: Array) -> None:
        """Keep what speeds and commands there were since an alarm; before one, those of now."""
        speed = np.where(np.isfinite(one.measured_rad_s), np.abs(one.measured_rad_s), np.abs(one.predicted_rad_s))
        now = np.stack((speed, speed, one.command, one.command))
        self._command = np.where(np.isfinite(one.command), one.command, self._command)
        lowest, highest = np.fmin(self._seen[::2], now[::2]), np.fmax(self._seen[1::2], now[1::2])
        self._seen[::2] = np.where(was_active, lowest, now[::2])
        self._seen[1::2] = np.where(was_active, highest, now[1::2])

    def state(self, input_producer: str) -> ScorerState:
        """The state to continue from. input_producer: of the last block."""
        return ScorerState(input_producer, self.arrays(), self.alarms.state, self.wear.state)

    def continue_from(self, state: ScorerState, *, same_twin: bool, keeps_wear: bool) -> None:
        """Continue from a state.

        same_twin: it is by this twin; else only the alarms are restored. keeps_wear: and the wear, as that of the same
        fans by another twin.

        Raises:
            ValueError, LookupError: it is damaged, or of other fans. A part may have been taken then.
        """
        if len(state.alarms.stood) != self.fans:
            raise ValueError("a state of another number of fans")
        self.alarms.state = state.alarms
        if same_twin or keeps_wear:
            self.wear.continue_from(state.wear, part("wear", state.arrays), same_twin=same_twin)
        if same_twin:
            self.restore(state.arrays)

    def restore(self, stored: Mapping[str, Array]) -> None:
        """See Saved."""
        if stored["_period_ns"] < 0 or not np.isin(stored["_kind"], np.arange(len(KINDS))).all():
            raise ValueError("an unknown period, or a fan that does something unknown")
        self._open(int(stored["_period_ns"]) or NS_PER_S)
        super().restore(stored)
