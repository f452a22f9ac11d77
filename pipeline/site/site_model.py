"""The model of a site now: the newest sample and the alarm of every fan, the stages, the twins.

Every output has one and reads from it, and so do the commands that watch a site. It is filled in one thread and read in
others.
"""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from fantwin.pipeline.config.registry import STAGES
from fantwin.pipeline.config.settings import FanConfig, TrayConfig
from fantwin.pipeline.config.shards import StageProcess
from fantwin.pipeline.site.alarm_book import AlarmBook
from fantwin.pipeline.site.alarm_history import AlarmHistory
from fantwin.pipeline.site.alarm_rates import LEARNED, AlarmRates, JudgedTime
from fantwin.pipeline.site.fan_history import COLUMNS, Curves, FanHistory, channels_of, values_of
from fantwin.pipeline.site.fleet import IS_AT_REST, Fan, FanGroup, FanNow, Fleet, last_sample
from fantwin.pipeline.site.stage_states import HeardHealth, StageState, stage_states
from fantwin.schemas.codec import CodecError, decode
from fantwin.schemas.enums import Feedback, InvalidReason, StageStatus, Transition
from fantwin.schemas.envelope import Envelope
from fantwin.schemas.health import Health, Learning
from fantwin.schemas.messages import Alarm, Array, ModelCard, Score, ScorerSnapshot
from fantwin.scoring.alarms.current_alarms import CurrentAlarm
from fantwin.scoring.calibration.calibration import ObservedRate, declared_per_day
from fantwin.scoring.wear.recorded_wear import wear_in, wear_rows

SILENT_AFTER_S = 5.0
"""a tray without a score for so long is silent; a fan is judged now if it was this recently"""


@dataclass(frozen=True, eq=False)
class TrayNow:
    """The newest sample of a tray: values (fans, len(CURVES) + len(channels)), and whether each fan is judged (fans,).

    is_heard: False: it has sent none for long, and this is an old one.
    """

    tray: str
    t_ns: int
    values: Array
    is_judged: Array
    invalid_reason: Array
    is_heard: bool
    channels: tuple[str, ...] = ()


class SiteModel:
    """Thread-safe."""

    def __init__(
        self,
        site: str,
        trays: Sequence[TrayConfig],
        alarms: AlarmHistory | None = None,
        *,
        expected: Sequence[StageProcess] = (),
        keeps_curves: bool = False,
        keeps_rates: bool = False,
        now_s: Callable[[], float] = time.monotonic,
    ) -> None:
        """An empty model.

        Args:
            site: its name.
            trays: whose fans it knows.
            alarms: the history that alarms are added to, for `past`; None: none is kept.
            expected: the processes that the configuration asks for: `stages` shows also those that never came.
            keeps_curves: of the last hour of every fan, for `history`; of 5,000 fans they take 86 MB.
            keeps_rates: in the history, for how long fans are judged, for `observed_rates`.
            now_s: a clock that is never set.
        """
        self._now_s = now_s
        self.site = site
        self.trays = tuple(trays)
        self._by_name = {tray.name: tray for tray in trays}
        self._lock = threading.Lock()
        self._fleet = Fleet(trays)
        self._history = FanHistory(trays) if keeps_curves else None
        self._heard_s: dict[str, float] = {}
        self._newest: dict[str, Score] = {}
        """by tray, its last sample alone"""
        self._raised: Counter[tuple[str, int, str]] = Counter()
        """by tray, fan and severity"""
        self._counted: dict[tuple[str, int], tuple[int, int]] = {}
        """by tray and fan: the onset of the alarm that was counted last, and its worst severity"""
        self._alarms = AlarmBook()
        self._history_of_alarms = alarms
        self._stages: dict[tuple[str, str], HeardHealth] = {}
        self._expected = expected
        self._twins: dict[str, ModelCard] = {}
        self._wear: dict[str, tuple[int, Sequence[Mapping[str, Any]]]] = {}
        """by tray: the time of the snapshot, and its rows"""
        self._rates = AlarmRates(alarms) if keeps_rates and alarms else None
        self._judged = JudgedTime()
        self._judging: dict[str, tuple[str, float | None]] = {}
        """by tray, the name of its twin for the judged time, and the rate that it declares"""
        self.refused_scores = 0
        """with another number of fans than the configuration says, or not to be decoded"""
        self.wrong_fans: dict[str, int] = {}
        """by tray, how many fans its last score had, if they are not those of the configuration"""

    def add_score(self, envelope: Envelope, columns: Sequence[str] = COLUMNS, every_s: float = 0.0) -> Score | None:
        """A score of a known tray has arrived; returns it with these columns, or None if it cannot be shown. It is not
        kept if another one was kept less than every_s ago."""
        try:
            score = decode(Score, envelope.payload, columns)
        except CodecError:
            self.refused_scores += 1
            return None
        is_kept = self.wants_score(tray := envelope.header.tray, every_s) or score.fans != self._by_name[tray].fans
        return self.add_decoded_score(tray, score) if is_kept else score

    def wants_score(self, tray: str, every_s: float) -> bool:
        """Whether the last score of a known tray is older than `every_s`.

        It takes no lock: threads of the bus ask, and nothing may wait for a disk on which the history is saved.
        """
        return self._now_s() - self._heard_s.get(tray, -np.inf) >= every_s

    def add_decoded_score(self, name: str, score: Score) -> Score | None:
        """The same for one that has been decoded, of the tray whose key it came on."""
        tray = self._by_name[name]
        if score.fans != tray.fans or not len(score.t_ns):
            self.refused_scores += score.fans != tray.fans
            self.wrong_fans[name] = score.fans
            return None
        with self._lock:
            self.wrong_fans.pop(name, None)
            now_s = self._heard_s[name] = self._now_s()
            self._newest[name] = last_sample(score, COLUMNS)
            self._fleet.update(name, score, now_s)
            if self._history is not None:
                self._history.add(score)
            if self._rates is not None and tray.name in self._judging:
                stretches = self._judged.add(score, *self._judging[tray.name])
                if stretches:
                    self._rates.catch_up(stretches)
        return score

    def add_alarm(self, alarm: Alarm) -> bool:
        """A transition of a fan of the site has arrived; returns whether it is new."""
        with self._lock:
            self._fleet.add_alarm(self._alarms.add(alarm).newest)  # this one may be late
            is_new = self._history_of_alarms is None or self._history_of_alarms.add(alarm)
            if is_new and alarm.transition in (Transition.RAISED, Transition.SEVERITY):
                self._count(alarm)
            return is_new

    def drop_alarms(self, is_dropped: Callable[[Alarm], bool]) -> None:
        """Forget the alarm messages to which this applies."""
        with self._lock:
            self._alarms.drop(is_dropped)

    def _count(self, alarm: Alarm) -> None:
        """Once for each severity that it reaches."""
        name = (alarm.header.tray, alarm.fan)
        onset_t_ns, worst = self._counted.get(name, (0, 0))
        if alarm.onset_t_ns != onset_t_ns or alarm.severity > worst:
            self._counted[name] = (alarm.onset_t_ns, int(alarm.severity))
            self._raised[*name, alarm.severity.name.lower()] += 1

    def add_health(self, health: Health) -> None:
        """A stage has reported."""
        name = (health.stage, health.instance)
        with self._lock:
            before = self._stages.get(name)
            previous = before.health if before and before.health.header.producer == health.header.producer else None
            self._stages[name] = HeardHealth(health, previous, self._now_s())

    def add_twin(self, card: ModelCard) -> None:
        """A tray has another twin."""
        tray = self._by_name.get(card.header.tray)
        name = LEARNED if tray and tray.twin is None else card.sha256
        with self._lock:
            self._twins[card.header.tray] = card
            self._judging[card.header.tray] = (name, declared_per_day(card.card_json))

    def notice_silence(self) -> None:
        """Trays that have sent no score for long are silent."""
        before_s = self._now_s() - SILENT_AFTER_S
        with self._lock:
            for tray, heard_s in self._heard_s.items():
                if heard_s < before_s:
                    self._fleet.silence(tray, int(self._newest[tray].t_ns[-1]))

    def is_silent(self, tray: str) -> bool:
        """Whether a tray has sent no score for long, or never."""
        with self._lock:
            return self._heard_s.get(tray, -np.inf) < self._now_s() - SILENT_AFTER_S

    def not_judged(self, tray: str) -> dict[InvalidReason, tuple[int, ...]] | None:
        """The fans of a tray that are not judged now, by reason; None: no score of it comes."""
        silent = self.is_silent(tray)
        with self._lock:
            found = self._fleet.not_judged(tray, self._now_s() - SILENT_AFTER_S)
        return None if found and silent else found

    def at_rest(self, tray: str) -> dict[InvalidReason, tuple[int, ...]]:
        """The fans of a tray that are stopped or starting now."""
        if self.is_silent(tray):
            return {}
        with self._lock:
            return self._fleet.at_rest(tray)

    def tray(self, name: str) -> TrayConfig | None:
        """None: there is no such tray."""
        return self._by_name.get(name)

    def about(self, fan: Fan) -> FanConfig:
        """Name and place of a fan of the site."""
        return self._by_name[fan.tray].fan[fan.number]

    def fans_now(self) -> tuple[Array, Array]:
        """All fans at a glance, tray after tray: the class of each fan's cell, (fans,) uint8, an index into
        `SHOWN_CLASSES`, and its score, (fans,) float32, NaN where it is not judged."""
        with self._lock:
            return self._fleet.classes(), self._fleet.scores()

    def every_fan(self) -> list[FanNow]:
        """All fans in words, the worst first."""
        with self._lock:
            return self._fleet.every_fan()

    def fan_now(self, fan: Fan) -> FanNow:
        """One of them."""
        with self._lock:
            return self._fleet.fan_now(fan)

    def words_now(self, fans: Sequence[Fan]) -> list[str]:
        """Words for each: that it is stopped, starting or like a healthy fan again; empty: none of these."""
        heard = {tray: not self.is_silent(tray) for tray in {fan.tray for fan in fans}}
        with self._lock:
            return [self._fleet.words_now(fan) if heard[fan.tray] else "" for fan in fans]

    def in_alarm(self) -> list[Fan]:
        """The fans in an alarm that no operator has silenced, the highest score first."""
        with self._lock:
            return self._fleet.alarms()

    def counts(self) -> dict[str, int]:
        """How many fans are in alarm, suspect, not judged, and in an alarm that an operator has silenced."""
        with self._lock:
            found = self._fleet.counts()
        return {
            "in_alarm": found[FanGroup.ALARM],
            "suspect": found[FanGroup.SUSPECT],
            "not_judged": found[FanGroup.NOT_JUDGED],
            "silenced": found[FanGroup.SILENCED],
        }

    def history(self, fan: Fan, since_t_ns: int) -> Curves:
        """The last hour of a fan."""
        with self._lock:
            return self.kept.of(fan.tray, fan.number, since_t_ns)

    @property
    def kept(self) -> FanHistory:
        """The last hour of all fans."""
        assert self._history is not None, "no curves are kept"
        return self._history

    def series(self, fan: Fan) -> tuple[Array, Array, Array, Array]:
        """The last hour of a fan with its extremes: `FanHistory.series`."""
        with self._lock:
            return self.kept.series(fan.tray, fan.number)

    def newest_t_ns(self, tray: str) -> int:
        """Time of the newest sample of a tray; 0: there was none."""
        with self._lock:
            newest = self._newest.get(tray)
        return int(newest.t_ns[-1]) if newest else 0

    def trays_now(self) -> list[TrayNow]:
        """The newest sample of each tray that was ever heard."""
        after_s = self._now_s() - SILENT_AFTER_S
        with self._lock:
            newest = [(tray, score, self._heard_s[tray] >= after_s) for tray, score in self._newest.items()]
        return [
            TrayNow(
                tray,
                int(score.t_ns[-1]),
                values_of(score, channels_of(score), -1),
                score.valid[-1] | IS_AT_REST[score.invalid_reason[-1]],
                score.invalid_reason[-1],
                is_heard,
                channels_of(score),
            )
            for tray, score, is_heard in newest
        ]

    def raised(self) -> dict[tuple[str, int, str], int]:
        """How many alarms have reached a severity since the gateway began, by tray, fan and severity."""
        with self._lock:
            return dict(self._raised)

    def current_alarms(self) -> list[CurrentAlarm]:
        """The alarm of each fan that had one, by tray and fan."""
        with self._lock:
            return self._alarms.all()

    def current_alarm(self, fan: Fan) -> CurrentAlarm | None:
        """That of one fan; None: it had none."""
        with self._lock:
            return self._alarms.of(fan)

    @property
    def past(self) -> AlarmHistory:
        """The history of alarms; its file is read in any thread."""
        assert self._history_of_alarms is not None, "no history is kept"
        return self._history_of_alarms

    def add_snapshot(self, snapshot: ScorerSnapshot) -> None:
        """A scorer has sent its state, of which the wear is kept."""
        tray = snapshot.header.tray
        with self._lock:
            kept = self._wear.get(tray)
            if kept is not None and kept[0] > snapshot.t_ns:
                return
        wear = wear_in(snapshot)
        if wear is not None and len(wear["fans"]) == self._by_name[tray].fans:
            with self._lock:
                self._wear[tray] = (snapshot.t_ns, wear_rows(tray, snapshot.t_ns, wear, self._by_name[tray].names))

    def learning(self) -> dict[str, Learning]:
        """What the first twin of each tray that has none waits for."""
        before_s = self._now_s() - SILENT_AFTER_S
        with self._lock:
            heard = [each.health for each in self._stages.values() if each.heard_s >= before_s]
        return {each.tray: each for health in heard for each in health.learning if not health.is_last}

    def every_wear(self) -> Sequence[Mapping[str, Any]]:
        """The wear of each fan whose wear is known, one row each."""
        with self._lock:
            return [row for _, rows in self._wear.values() for row in rows]

    def wear(self, fan: Fan) -> Sequence[Mapping[str, Any]]:
        """The wear of a fan as of the last snapshot of its scorer, one row; empty: none is known."""
        with self._lock:
            _, rows = self._wear.get(fan.tray, (0, ()))
        return [row for row in rows if row["fan"] == fan.number]

    def feedback_on(self, alarms: Sequence[Alarm]) -> list[Feedback]:
        """What operators said last of the alarm that each of these messages is about."""
        if self._rates is None:
            return [alarm.feedback for alarm in alarms]
        with self._lock:
            self._rates.catch_up(())
            return [self._rates.feedback(alarm.header.tray, alarm.fan, alarm.onset_t_ns) for alarm in alarms]

    def observed_rates(self) -> dict[str, ObservedRate]:
        """Of each tray, the rate of false alarms beside the declared one: `AlarmRates.observed`."""
        if self._rates is None:
            return {}
        with self._lock:
            self._rates.catch_up(self._judged.growing())
            return self._rates.observed()

    def twin(self, tray: str) -> ModelCard | None:
        """The twin in force; None: it has not been heard."""
        return self._twins.get(tray)

    def stages(self) -> list[StageState]:
        """The stages that are expected or have been heard. One that is silent for long may have left the bus."""
        now_s = self._now_s()
        with self._lock:
            heard = list(self._stages.values())
        views = [each.view(now_s, alive=each.health.status != StageStatus.STOPPED) for each in heard]
        alive = {(view.health.stage, view.health.instance) for view in views if view.alive}
        rank = {name: number for number, name in enumerate(STAGES)}
        return sorted(stage_states(views, alive, self._expected), key=lambda state: rank.get(state.stage, len(rank)))

    def problem(self) -> str:
        """What is wrong with the history of alarms; empty if nothing is."""
        return "; ".join(each.problem for each in (self._history_of_alarms, self._rates) if each and each.problem)

    def close(self) -> None:
        """Leave complete files."""
        with self._lock:
            if self._rates is not None:
                self._rates.catch_up(self._judged.growing())
            if self._history_of_alarms is not None:
                self._history_of_alarms.close()
