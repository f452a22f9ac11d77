"""Which fans are being judged now. "No alarms" means that no fan has a fault only if all fans are judged."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fantwin.pipeline.bus.session import Bus
from fantwin.pipeline.config.models import TrayConfig
from fantwin.pipeline.config.registry import STAGES
from fantwin.pipeline.runtime.figures import without_figures
from fantwin.pipeline.site.site_state import StageState, Word
from fantwin.pipeline.site.site_watcher import SiteWatcher
from fantwin.schemas.codec import CodecError, decode
from fantwin.schemas.enums import InvalidReason
from fantwin.schemas.fan_numbers import fans_in_words
from fantwin.schemas.messages import Alarm, Score
from fantwin.schemas.topics import tray_key
from fantwin.scoring.alarms.current_alarms import CurrentAlarm
from fantwin.scoring.alarms.unscored_monitor import JUDGED_AT_REST, REASONS
from fantwin.scoring.alarms.words_now import STARTING, STOPPED, words_now

JUDGED_WITHIN_S = 5.0
"""a fan is judged now if it had a valid score, or was stopped or starting, this recently"""
_SAMPLED_S = 0.1  # scores of a tray are looked at this often: a fast line sends hundreds a second
_LAST_JUDGE = "scorer"


@dataclass(frozen=True)
class Unjudged:
    """Fans of one tray that are not judged, for one reason; empty `fans`: no fan of the tray is judged."""

    tray: str
    fans: tuple[int, ...]
    why: str

    def concerns(self, tray: str, fan: int) -> bool:
        """Whether a fan is one of them."""
        return tray == self.tray and (not self.fans or fan in self.fans)

    def line(self) -> str:
        """For people."""
        if not self.fans:
            return f"{self.tray}: no fan is judged: {self.why}"
        names = fans_in_words(self.fans)
        return f"{self.tray}: {'fan' if len(self.fans) == 1 else 'fans'} {names} not judged: {self.why}"

    def as_json(self) -> dict[str, object]:
        """For machines; no fans: all of the tray."""
        return {"tray": self.tray, "fans": list(self.fans), "why": self.why}


@dataclass(frozen=True)
class AtRest:
    """Fans of one tray that their command stops, or that are starting."""

    tray: str
    fans: tuple[int, ...]
    reason: InvalidReason

    def line(self) -> str:
        """For people."""
        names = fans_in_words(self.fans)
        return f"{self.tray}: {'fan' if len(self.fans) == 1 else 'fans'} {names}: {self.words}"

    @property
    def words(self) -> str:
        """The state, for people."""
        if self.reason != InvalidReason.STOPPED:
            return STARTING
        return STOPPED if len(self.fans) == 1 else STOPPED.replace("its", "their")

    def as_json(self) -> dict[str, object]:
        """For machines."""
        return {"tray": self.tray, "fans": list(self.fans), "state": self.reason.words}


class JudgedFans:
    """Listens to the scores of a site. Thread-safe."""

    def __init__(
        self,
        bus: Bus,
        site: str,
        trays: Sequence[TrayConfig],
        watcher: SiteWatcher,
        now_s: Callable[[], float] = time.monotonic,
    ) -> None:
        """watcher: knows whose scores count."""
        self._site = site
        self._watcher = watcher
        self._trays = trays
        self._now_s = now_s
        self._lock = threading.Lock()
        self._seen_s: dict[str, float] = {}
        """by tray: when a score was looked at"""
        self._judged_s = {tray.name: np.full(tray.fans, -np.inf) for tray in trays}
        self._reasons = {tray.name: np.zeros(tray.fans, np.uint8) for tray in trays}
        self._states = {tray.name: np.zeros(tray.fans, np.uint8) for tray in trays}
        for tray in trays:
            bus.subscribe(tray_key(site, tray.name, "score"), lambda _key, data, name=tray.name: self.add(name, data))

    def add(self, tray: str, payload: bytes) -> None:
        """A score of a tray has arrived."""
        now_s = self._now_s()
        if now_s - self._seen_s.get(tray, -np.inf) < _SAMPLED_S:
            return
        try:
            score = decode(Score, payload)
        except CodecError:
            return
        judged_s = self._judged_s[tray]
        if not isinstance(score, Score) or score.fans != len(judged_s) or not len(score.valid):
            return
        if not self._watcher.counts(tray_key(self._site, tray, "score"), score.header.producer):
            return
        with self._lock:
            self._seen_s[tray] = now_s
            judged = score.valid | np.isin(score.invalid_reason, JUDGED_AT_REST)
            judged_s[judged.any(axis=0)] = now_s
            self._reasons[tray], self._states[tray] = score.invalid_reason[-1], score.state[-1]

    def at_rest(self) -> list[AtRest]:
        """The fans that are stopped or starting now; they are judged by whether they stand or turn as commanded."""
        oldest_s = self._now_s() - JUDGED_WITHIN_S
        with self._lock:
            return [
                AtRest(tray.name, tuple(np.flatnonzero(self._reasons[tray.name] == reason).tolist()), reason)
                for tray in self._trays
                for reason in JUDGED_AT_REST
                if self._seen_s.get(tray.name, -np.inf) >= oldest_s and (self._reasons[tray.name] == reason).any()
            ]

    def words_now(self) -> dict[tuple[str, int], str]:
        """What each fan does that is stopped, starting or returning now, for people, by tray and fan."""
        oldest_s = self._now_s() - JUDGED_WITHIN_S
        with self._lock:
            newest = [
                (tray.name, fan, words_now(state, reason))
                for tray in self._trays
                if self._seen_s.get(tray.name, -np.inf) >= oldest_s
                for fan, (state, reason) in enumerate(
                    zip(self._states[tray.name].tolist(), self._reasons[tray.name].tolist(), strict=True)
                )
            ]
        return {(tray, fan): words for tray, fan, words in newest if words}

    def unjudged(self, states: Sequence[StageState]) -> list[Unjudged]:
        """The fans that are not judged now, and why. states: of the site's stages; one may be the reason."""
        oldest_s = self._now_s() - JUDGED_WITHIN_S
        found: list[Unjudged] = []
        with self._lock:
            for tray in self._trays:
                if late := _why_late(tray.name, states):
                    found.append(Unjudged(tray.name, (), late))
                    continue
                fans = np.flatnonzero(self._judged_s[tray.name] < oldest_s)
                if len(fans) and self._seen_s.get(tray.name, -np.inf) < oldest_s:
                    found.append(Unjudged(tray.name, (), _why_no_scores(tray.name, states)))
                    continue
                reasons = self._reasons[tray.name][fans]
                for reason in np.unique(reasons).tolist():
                    of_reason = tuple(fans[reasons == reason].tolist())
                    why = REASONS.get(InvalidReason(reason), InvalidReason(reason).words)
                    found.append(Unjudged(tray.name, () if len(of_reason) == tray.fans else of_reason, why))
        return found


def as_judged(alarms: Sequence[CurrentAlarm], unjudged: Sequence[Unjudged]) -> list[CurrentAlarm]:
    """The alarms; those that are active and whose fan is not judged now are not confirmed by data. Their scorer says so
    only when samples without a speed arrive, which may take minutes while a link could be cut."""

    def is_stale(alarm: Alarm) -> bool:
        return alarm.active and any(each.concerns(alarm.header.tray, alarm.fan) for each in unjudged)

    return [
        replace(each, newest=replace(each.newest, stale=True)) if is_stale(each.newest) else each for each in alarms
    ]


class JudgedChanges:
    """What has changed since the fans that are not judged were listed."""

    def __init__(self, listed: Sequence[Unjudged]) -> None:
        self._known = _by_tray(listed)

    def lines(self, unjudged: Sequence[Unjudged]) -> list[str]:
        """Of each tray where other fans are not judged, or for another reason: these fans, or that none is left."""
        before, self._known = self._known, _by_tray(unjudged)
        changed = [
            tray
            for tray in dict.fromkeys((*before, *self._known))
            if _meaning(before.get(tray, [])) != _meaning(self._known.get(tray, []))
        ]
        return [
            line
            for tray in changed
            for line in [each.line() for each in self._known.get(tray, [])] or [f"{tray}: every fan is judged now"]
        ]


def _by_tray(unjudged: Sequence[Unjudged]) -> dict[str, list[Unjudged]]:
    found: dict[str, list[Unjudged]] = {}
    for each in unjudged:
        found.setdefault(each.tray, []).append(each)
    return found


def _meaning(unjudged: Sequence[Unjudged]) -> list[tuple[tuple[int, ...], str]]:
    """Without the figures of the reasons, which change all the time."""
    return [(each.fans, without_figures(each.why)) for each in unjudged]


def _why_late(tray: str, states: Sequence[StageState]) -> str:
    """The first stage on the way from the device to the scores that is late: scores come, of earlier samples."""
    late = (state for state in _on_the_way(tray, states) if state.word == Word.LATE)
    return next((f"{state.label}: {state.detail}" for state in late), "")


def _on_the_way(tray: str, states: Sequence[StageState]) -> list[StageState]:
    stages = list(STAGES)[: list(STAGES).index(_LAST_JUDGE) + 1]
    return [state for state in states if state.is_expected and state.stage in stages and state.has(tray)]


def _why_no_scores(tray: str, states: Sequence[StageState]) -> str:
    """The first stage on the way from the device to the scores that does not work."""
    for state in _on_the_way(tray, states):
        problem = state.view.health.problem if state.view and state.word == Word.DEGRADED else ""
        if state.is_fault or state.word == Word.WAITING or problem:
            return f"{state.label}: {problem or state.detail}"
    return "no score arrives"
