"""The scorer of one tray: samples that come again, requests, snapshots and health, around `TrayScorer`.

See docs/explanation/deciding.md.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from fantwin.pipeline.prediction.new_samples import BEGINNING_NS, NewSamples
from fantwin.pipeline.runtime.stage import Core, never
from fantwin.pipeline.tray_scoring.healthy_twin import HealthyTwin
from fantwin.pipeline.tray_scoring.overview_rows import OverviewRows
from fantwin.pipeline.tray_scoring.scorer_config import ScorerConfig
from fantwin.pipeline.tray_scoring.scorer_state import ScorerState, with_times_moved
from fantwin.pipeline.tray_scoring.snapshot_store import SnapshotStore
from fantwin.pipeline.tray_scoring.tray_scorer import JudgedShare, TrayScorer
from fantwin.schemas.enums import Transition
from fantwin.schemas.fan_names import NO_NAMES, FanNames
from fantwin.schemas.messages import Alarm, Message, ModelCard, Overview, Prediction, Request, Score, ScorerSnapshot
from fantwin.schemas.units import NS_PER_S, SpeedUnit
from fantwin.scoring.alarms.alarm_text import AlarmText
from fantwin.scoring.alarms.unscored_monitor import UnscoredMonitor
from fantwin.scoring.model.decision import FORGETS_S

SNAPSHOT_PERIOD_NS = 60 * NS_PER_S  # between snapshots while nothing happens
SNAPSHOT_PERIOD_SAMPLES = 3000  # at least: at slow rates snapshots would be most of a recording
MOST_FANS_AT_ONCE = 64  # of a tray whose snapshot is taken with each alarm
SAVED_OF_PUBLISHED = 3  # of a larger tray: every third is published while nothing happens, for the recording's size
REST_NS_PER_FAN = 5_000_000  # between snapshots with alarms of a larger tray: each takes a millisecond a fan after days
NOT_JUDGED_S = 10.0  # health names a fan that has had no score for this long: beyond the start of a free run
SHOWN_NS = 60 * NS_PER_S  # how long health says that a snapshot was not used
NEW_START = "what was learned of the fans, alarms and wear start from the beginning"
ANOTHER_TWIN = f"the snapshot is of another twin: {NEW_START}; shelved and out of service are kept"
EARLIER_TWIN = (
    "the snapshot is of the previous twin: what was learned of the fans and alarms start from the beginning, wear "
    "continues; shelved and out of service are kept"
)
NOT_READ = f"the snapshot cannot be read: {NEW_START}, and nothing is shelved or out of service"
NOT_CALIBRATED = (
    "the twin is not calibrated: its alarms rest on what fans have in common, and their rate is not checked; "
    "see fantwin calibrate"
)
RESTORE_ERRORS = (ValueError, LookupError, TypeError, AttributeError, OverflowError)
SET_BACK_NS = NS_PER_S  # a snapshot further ahead of the present is of a clock that was set back since


class ScorerCore(Core):
    """The scorer of one tray."""

    def __init__(
        self,
        fans: int,
        speed_unit: SpeedUnit,
        config: ScorerConfig,
        twin: HealthyTwin,
        snapshot_store: SnapshotStore | None = None,
        started_t_ns: int | None = None,
        continues: ScorerSnapshot | None = None,
        is_learned: bool = False,
        is_replayed: Callable[[], bool] = never,
        names: FanNames = NO_NAMES,
    ) -> None:
        """snapshot_store: where snapshots are kept; None: nowhere, as in a replay. started_t_ns: the present time.
        continues: the last snapshot of the twin before this one, instead of the one in the store. is_learned: the twin
        is one of several of the same fans, so wear goes on from one to the next. is_replayed: see Context."""
        self._fans = fans
        self._twin = twin
        self._config = config
        self._text = AlarmText(speed_unit, twin.advice.command_unit, names)
        self._is_learned = is_learned
        self._is_replayed = is_replayed
        self._unscored = UnscoredMonitor(fans, round(NOT_JUDGED_S * NS_PER_S), names)
        self._snapshot_store = snapshot_store
        self._samples = NewSamples(fans, "predictions", "scorer")
        self._judged_share = JudgedShare()
        self._counts: Counter[str] = Counter()
        self._not_restored = ""
        """why the snapshot was not used as a whole, for people"""
        self._set_back, self._set_back_until_t_ns = "", 0
        """note for people that the snapshot was moved back in time, and until when it is shown"""
        self._rest_ns = fans * REST_NS_PER_FAN if fans > MOST_FANS_AT_ONCE else 0
        self._owes_snapshot = False
        """alarms have changed since the last one"""
        self._unpublished = SAVED_OF_PUBLISHED - 1
        """snapshots that were saved since the last one that was published; the first one is"""
        self._start_new()
        stored = snapshot_store.load() if snapshot_store and not continues else None
        self._at_start = self.restore(stored) if stored else self._continued(continues) if continues else []
        """messages to be emitted first"""
        is_ahead = started_t_ns is not None and not continues and self._samples.last_t_ns > started_t_ns + SET_BACK_NS
        self._may_be_set_back = is_ahead and self._is_restored
        """the snapshot is of later times than now: the first prediction shows whether all times have gone back"""

    def _start_new(self) -> None:
        self.tray = TrayScorer(self._fans, self._text, self._config, self._twin)
        self._overview = OverviewRows()
        self._samples.last_t_ns = self._snapshot_t_ns = BEGINNING_NS
        self._shown_until_t_ns = np.iinfo(np.int64).max
        """end of the time in which health says that a snapshot was not used; not known before the first sample"""
        self._input_producer = ""
        """producer of the last prediction"""
        self._is_restored = False
        """true while a restored snapshot was not yet compared with the first prediction"""

    def restore(self, snapshot: ScorerSnapshot) -> list[Alarm | ScorerSnapshot]:
        """Continue from a snapshot. Returns the messages that report it.

        Of one by another twin only what belongs to operators is restored: shelved, out of service, and the requests
        already answered; if the twin is a learned one, the wear as well. One that is damaged is refused as a whole.
        """
        same_twin = snapshot.twin_sha256 == self._twin.sha256
        self._start_new()
        try:
            state = ScorerState.of(snapshot)
            self.tray.continue_from(state, same_twin=same_twin, keeps_wear=self._is_learned)
        except RESTORE_ERRORS:
            self._start_new()
            self._counts["snapshots_not_understood"] += 1
            self._not_restored = NOT_READ
            return []
        if not same_twin:
            self._counts["snapshots_of_another_twin"] += 1
            self._not_restored = EARLIER_TWIN if self._is_learned else ANOTHER_TWIN
        self._samples.last_t_ns = self._snapshot_t_ns = snapshot.t_ns
        self._input_producer, self._is_restored = state.input_producer, True
        if self._not_restored:
            return [replace(snapshot, restored=True), *self.tray.alarms.discard_all(snapshot.t_ns, keep_silenced=True)]
        return [replace(snapshot, restored=True), *self.tray.alarms.republish()]

    def _continued(self, snapshot: ScorerSnapshot) -> list[Alarm | ScorerSnapshot]:
        """Take over from another core; returns what has changed. Of another twin, only wear and what belongs to
        operators stay."""
        _, *alarms = self.restore(snapshot)
        if not self._not_restored:
            return []
        if self._not_restored in (ANOTHER_TWIN, EARLIER_TWIN):  # as it should be
            self._not_restored = ""
        return alarms

    def tick(self, now_ns: int) -> list[Alarm | ScorerSnapshot]:
        """Emit once what was restored, also if it is then discarded: a replay restores it, too."""
        if self._may_be_set_back:
            return []
        at_start, self._at_start = self._at_start, []
        return at_start

    def step(self, item: Prediction | Request | ModelCard) -> list[Message]:
        """Score a block and return its score and alarm transitions; or answer a request. The twin is that of the
        configuration, so its card says nothing new."""
        if isinstance(item, ModelCard):
            return []
        if isinstance(item, Request):
            self._may_be_set_back = False
            return [*self.tick(0), *self._answer(item)]
        if not self._samples.fits(item):
            return []
        self._set_snapshot_back(item)
        before_score = [*self.tick(0), *self._discard_if_replayed(item)]
        block = self._samples.take(item)
        return [*before_score, *self._score(block, item.header.producer)] if block is not None else [*before_score]

    def _score(self, block: Prediction, producer: str) -> list[Score | Overview | Alarm | ScorerSnapshot]:
        self._shown_until_t_ns = min(self._shown_until_t_ns, int(block.t_ns[0]) + SHOWN_NS)
        self._input_producer = producer
        score, alarms = self.tray.score(block)
        self._unscored.update(block.period_ns, score.valid, score.invalid_reason)
        self._judged_share.add(score.valid, score.invalid_reason)
        self._owes_snapshot |= bool(alarms)
        overview = self._overview.add(score)
        snapshots = self._take_due_snapshot() if self._is_snapshot_due(block.period_ns) else []
        # the snapshot first: whoever takes over from one that is killed now must not raise these alarms again
        return [score, *overview, *snapshots, *alarms]

    def counters(self) -> Mapping[str, int]:
        """docs/explanation/deciding.md says what each counts."""
        alarms = self.tray.alarms
        of_alarms = {"alarms_raised": alarms.raised, "alarms_cleared": alarms.cleared}
        return {**self._counts, **self._samples.counters(), **of_alarms}

    def notes(self) -> list[str]:
        """Notes on where it continued from, if not from its file; on the share of the samples that was judged, and why
        the others were not; on fans that change slowly, and on tachos that are not sound."""
        of_twin = [] if self._twin.is_calibrated else [NOT_CALIBRATED]
        of_store = [self._snapshot_store.note] if self._snapshot_store and self._snapshot_store.note else []
        return [*of_twin, *of_store, *self._judged_share.notes, *self.tray.notices()]

    def problem(self) -> str:
        """Problem for people to look at: input, snapshot, fans without a score, wear."""
        is_new = self._samples.last_t_ns < self._shown_until_t_ns
        problems = [
            self._not_restored if is_new else "",
            self._set_back if self._samples.last_t_ns < self._set_back_until_t_ns else "",
            self._unscored.problem(),
            self._samples.problem(),
        ]
        problems += [self._snapshot_store.problem] if self._snapshot_store else []
        problems.append(self.tray.wear.problem(self._samples.last_t_ns))
        return "; ".join(filter(None, problems))

    def close(self) -> list[Overview | ScorerSnapshot]:
        """The rest of the overview, and the snapshot that the next session continues from."""
        snapshots = self.last_snapshot()
        self.abort()
        return snapshots

    def last_snapshot(self) -> list[Overview | ScorerSnapshot]:
        """The state now, after the overview up to now; nothing before the first sample."""
        return self._take_snapshot() if self._samples.last_t_ns > BEGINNING_NS else []

    def abort(self) -> None:
        """Save nothing; another process may use the snapshot."""
        if self._snapshot_store:
            self._snapshot_store.unlock()

    def _set_snapshot_back(self, item: Prediction) -> None:
        """Move the restored snapshot to before the first prediction, if the host clock was set back after it.

        How long nothing was judged is not known: longer than the evidence remembers. Only a snapshot that is also
        ahead of the host's time is moved. Otherwise a producer repeats what it has kept, or a recording is played.
        """
        if not self._may_be_set_back or not len(item.t_ns):
            return
        self._may_be_set_back = False
        first_t_ns, ahead_ns = int(item.t_ns[0]), self._samples.last_t_ns - int(item.t_ns[0])
        if item.header.producer == self._input_producer or ahead_ns < 0:
            return
        t_ns = first_t_ns - item.period_ns - 2 * round(FORGETS_S * NS_PER_S)
        self._at_start = self.restore(with_times_moved(self._snapshot(), t_ns - self._samples.last_t_ns))
        self._snapshot_t_ns = 0  # saved at once: a restart must not set back the same one again
        self._counts["snapshots_set_back"] += 1
        self._set_back_until_t_ns = first_t_ns + SHOWN_NS
        self._set_back = (
            f"the snapshot is {ahead_ns / NS_PER_S:.0f} s ahead of the samples, because the host clock was set back: "
            "what was learned of the fans, alarms and wear continue, with their times set back as well"
        )

    def _discard_if_replayed(self, item: Prediction) -> list[Alarm]:
        """Discard a restored snapshot if a replay plays samples from before it; return the messages on discarded
        alarms.

        On a live site a snapshot stays valid with older samples: a restarted producer repeats all that was kept.
        """
        if not self._is_restored or not len(item.t_ns):
            return []
        self._is_restored = False
        first_t_ns = int(item.t_ns[0])
        is_repeated = item.header.producer == self._input_producer  # what it has kept, in a replay as well
        if first_t_ns > self._samples.last_t_ns or is_repeated or not self._is_replayed():
            return []
        discarded, self._not_restored = self.tray.alarms.discard_all(first_t_ns, keep_silenced=False), ""
        self._start_new()
        self._counts["snapshots_of_other_times"] += 1
        return discarded

    def _answer(self, request: Request) -> list[Overview | Alarm | ScorerSnapshot]:
        alarms = self.tray.alarms.answer(request, max(self._samples.last_t_ns, 0))
        if not alarms:
            self._counts["requests_repeated"] += 1
            return []
        commissioned = np.zeros(self._fans, np.bool_)
        commissioned[[alarm.fan for alarm in alarms if alarm.transition == Transition.COMMISSIONING]] = True
        self.tray.recommission(commissioned, self._samples.last_t_ns)
        self._counts["requests"] += 1
        return [*self._take_snapshot(), *alarms]  # whoever has the answer can rely on it

    def _is_snapshot_due(self, period_ns: int) -> bool:
        """Return whether alarms have changed since the last snapshot, or it is old; period_ns: between samples."""
        rest_ns = self._rest_ns if self._owes_snapshot else max(SNAPSHOT_PERIOD_NS, SNAPSHOT_PERIOD_SAMPLES * period_ns)
        return self._samples.last_t_ns - self._snapshot_t_ns >= rest_ns

    def _take_due_snapshot(self) -> list[Overview | ScorerSnapshot]:
        """Save the state; returns the overview up to now, and the state if it is to be published, too."""
        unpublished = self._unpublished + 1
        is_published = not self._rest_ns or self._owes_snapshot or unpublished == SAVED_OF_PUBLISHED
        *overview, snapshot = self._take_snapshot()
        self._unpublished = 0 if is_published else unpublished
        return [*overview, snapshot] if is_published else overview

    def _take_snapshot(self) -> list[Overview | ScorerSnapshot]:
        """The state for a restart, after the overview up to now: the next scorer does not make that again."""
        self._snapshot_t_ns, self._owes_snapshot = self._samples.last_t_ns, False
        snapshot = self._snapshot()
        if self._snapshot_store:
            self._snapshot_store.save(snapshot)
        return [*self._overview.so_far(), snapshot]

    def _snapshot(self) -> ScorerSnapshot:
        state = self.tray.state(self._input_producer)
        return state.snapshot(max(self._samples.last_t_ns, 0), self._twin.sha256)
