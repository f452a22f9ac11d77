"""The scorer of a tray whose twin is learned while it runs: a core for each version, one at a time.

Predictions name their twin, and the integrator publishes a twin before its first prediction. So the core changes at the
same sample in a replay. Where only the calibration is new, what was learned of the fans, alarms and wear go on;
with another twin what was learned and alarms start from the beginning, except for what operators have set, and wear
goes on.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from fantwin.pipeline.config.settings import TrayConfig
from fantwin.pipeline.prediction.new_samples import BEGINNING_NS, are_newer
from fantwin.pipeline.prediction.tray_twin import TrayTwin, tray_twin, without_metadata
from fantwin.pipeline.runtime.inbox import MOST_REQUESTS
from fantwin.pipeline.runtime.stage import Core, StageError
from fantwin.pipeline.tray_scoring.scorer_core import ScorerCore
from fantwin.pipeline.tray_scoring.snapshot_store import SnapshotStore
from fantwin.pipeline.tray_scoring.tray_scorer import JudgedShare
from fantwin.schemas.blocks import select
from fantwin.schemas.enums import Action
from fantwin.schemas.messages import Message, ModelCard, Prediction, Request, ScorerSnapshot
from fantwin.scoring.score_message import unscored

MOST_HELD = 4096
"""messages that wait for their twin: 3 minutes in blocks of 0.05 s"""
LIMITS = ("name", "calibration")
"""the entries of a card that do not affect predictions"""
CoreOf = Callable[[TrayTwin, ScorerSnapshot | None], ScorerCore]
"""the core of a twin, which continues from the last snapshot of the one before it"""


class LearnedTwinScorer(Core):
    """Scores predictions with the limits of the twin that they name; without one, no sample is scored."""

    def __init__(self, tray: TrayConfig, core_of: CoreOf, store: SnapshotStore | None) -> None:
        """store: where the cores keep their snapshots, locked; None: nowhere, as in a replay."""
        self._tray = tray
        self._core_of = core_of
        self._store = store
        self._core: ScorerCore | None = None
        self._twin = ""
        """the name of the twin of the core"""
        self._cards: dict[str, ModelCard] = {}
        self._snapshot: ScorerSnapshot | None = None
        """to continue from with the first twin"""
        self._requests: list[Request] = []
        """that wait for it"""
        self._held: list[Prediction] = []
        """from the first one of a twin that has not arrived yet, after a restart"""
        self._producer = ""
        """who made the newest prediction"""
        self._newest_t_ns = BEGINNING_NS
        self._judged_share = JudgedShare()
        self._counts: Counter[str] = Counter()
        """of the cores before the current one"""
        self._problem = ""
        self._refused: ModelCard | None = None
        """the last twin that cannot be used"""
        stored = store.load() if store else None
        if stored:
            self._note_what_was_scored(stored)

    def restore(self, snapshot: ScorerSnapshot) -> list[Message]:
        """Continue from a snapshot as soon as there is a twin."""
        self._snapshot = snapshot
        self._note_what_was_scored(snapshot)
        return []

    def step(self, item: Prediction | Request | ModelCard) -> Sequence[Message]:
        """Score a block, answer a request, or receive a twin."""
        if isinstance(item, ModelCard):
            if not item.content:
                return []
            self._cards[item.twin] = item
            held, self._held = self._held, []
            return [message for prediction in held for message in self.step(prediction)]
        if isinstance(item, Request):
            return self._answer(item)
        if self._held or (item.twin and item.twin not in self._cards):
            self._held.append(item)
            if len(self._held) > MOST_HELD:
                self._counts["lost_without_twin"] += 1
                del self._held[0]
            return []
        return self._score(item)

    def _answer(self, request: Request) -> Sequence[Message]:
        """Answers to a request; before the first twin it waits. Those about a sweep are for the learner."""
        if request.action in (Action.SWEEP, Action.STOP_SWEEP):
            return []
        if self._core is not None:
            return self._core.step(request)
        if len(self._requests) < MOST_REQUESTS:
            self._requests.append(request)
        else:
            self._counts["refused_requests"] += 1
        return []

    def tick(self, now_ns: int) -> Sequence[Message]:
        """What the core of the twin emits."""
        return self._core.tick(now_ns) if self._core else []

    def close(self) -> Sequence[Message]:
        """The snapshot that the next session continues from."""
        if self._core:
            return self._core.close()
        self.abort()
        return []

    def last_snapshot(self) -> Sequence[Message]:
        """That of the core; nothing before the first twin."""
        return self._core.last_snapshot() if self._core else []

    def abort(self) -> None:
        """Save nothing; another process may use the snapshot."""
        if self._store:
            self._store.unlock()

    def counters(self) -> Mapping[str, int]:
        """Sums over the cores of all twins so far."""
        return self._counts + Counter(self._core.counters() if self._core else {})

    def notes(self) -> Sequence[str]:
        """Notes of the core; before the first twin, the reasons why nothing is judged."""
        return self._core.notes() if self._core else self._judged_share.notes

    def problem(self) -> str:
        """A twin that has not arrived or cannot be used, or what the core reports."""
        if self._held:
            return f"the twin {self._held[0].twin} has not arrived: {len(self._held)} messages wait for it"
        return self._problem or (self._core.problem() if self._core else "")

    def _note_what_was_scored(self, snapshot: ScorerSnapshot) -> None:
        """The session before this one has scored predictions up to then, perhaps of several twins."""
        with suppress(ValueError, LookupError, TypeError):
            self._producer = str(json.loads(snapshot.state_json)["input_producer"])
            self._newest_t_ns = snapshot.t_ns

    def _score(self, item: Prediction) -> list[Message]:
        is_repeated = item.header.producer == self._producer and not (item.t_ns > self._newest_t_ns).any()
        if item.twin != self._twin and (is_repeated or not len(item.t_ns)):
            return []
        changed = self._change_twin(item.twin) if item.twin != self._twin else []
        is_of_core = self._core is not None and item.twin == self._twin
        scored = self._core.step(item) if self._core and is_of_core else self._unscored(item)
        if len(item.t_ns):
            is_other = item.header.producer != self._producer
            self._producer = item.header.producer
            self._newest_t_ns = int(item.t_ns[-1]) if is_other else max(self._newest_t_ns, int(item.t_ns[-1]))
        return [*changed, *scored]

    def _change_twin(self, name: str) -> list[Message]:
        """Change to the core of a twin, if it has arrived; returns the messages of the change."""
        card = self._cards.get(name)
        if card is None or card is self._refused:
            return []
        try:
            twin = tray_twin(Path(name), card.content, self._tray.fans)
            before = self._core.last_snapshot() if self._core else []
            continues = next((each for each in before if isinstance(each, ScorerSnapshot)), None)
            if continues and self._has_other_limits_only(card):
                continues = replace(continues, twin_sha256=twin.sha256)  # what was learned, alarms and wear go on
            core = self._core_of(twin, continues)
        except StageError as error:
            self._problem, self._refused = str(error), card
            return []
        emitted: list[Message] = [*before]
        if self._core:
            self._counts.update(self._core.counters())
        if self._snapshot:
            emitted += core.restore(self._snapshot)
        self._core, self._twin, self._snapshot, self._problem = core, name, None, ""
        if continues:
            emitted += core.last_snapshot()  # a scorer that is killed now continues with the new twin
        emitted += [message for request in self._requests for message in core.step(request)]
        self._requests.clear()
        return emitted

    def _has_other_limits_only(self, card: ModelCard) -> bool:
        """Whether a twin predicts as the current one does."""
        now = self._cards[self._twin]
        if without_metadata(now.content) != without_metadata(card.content):
            return False
        cards = (json.loads(each.card_json) for each in (now, card))
        first, second = ({key: value for key, value in each.items() if key not in LIMITS} for each in cards)
        return first == second

    def _unscored(self, item: Prediction) -> list[Message]:
        new = are_newer(item.t_ns, self._newest_t_ns)
        if not new.any() or item.fans != self._tray.fans:
            return []
        score = unscored(item if new.all() else select(item, new))
        self._judged_share.add(score.valid, score.invalid_reason)
        return [score]
