"""Which fans are being judged now. "No alarms" means that no fan has a fault only if all fans are judged."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from fantwin.pipeline.config.registry import STAGES
from fantwin.pipeline.runtime.figures import without_figures
from fantwin.pipeline.site.site_model import SiteModel
from fantwin.pipeline.site.stage_states import StageState, Word
from fantwin.schemas.enums import InvalidReason
from fantwin.schemas.fan_names import NO_NAMES, FanNames
from fantwin.schemas.messages import Alarm
from fantwin.scoring.alarms.alarm_text import STARTING, STOPPED
from fantwin.scoring.alarms.current_alarms import CurrentAlarm
from fantwin.scoring.alarms.unscored_monitor import REASONS

_LAST_JUDGE = "scorer"


@dataclass(frozen=True)
class Unjudged:
    """Fans of one tray that are not judged, for one reason; empty `fans`: no fan of the tray is judged."""

    tray: str
    fans: tuple[int, ...]
    why: str
    names: FanNames = NO_NAMES

    def concerns(self, tray: str, fan: int) -> bool:
        """Whether a fan is one of them."""
        return tray == self.tray and (not self.fans or fan in self.fans)

    def line(self) -> str:
        """A text for people."""
        if not self.fans:
            return f"{self.tray}: no fan is judged: {self.why}"
        return f"{self.tray}: {self.names.labels(self.fans)} not judged: {self.why}"

    def as_json(self) -> dict[str, object]:
        """JSON values for machines; no fans: all of the tray."""
        return {"tray": self.tray, "fans": list(self.fans), "why": self.why}


@dataclass(frozen=True)
class AtRest:
    """Fans of one tray that their command stops, or that are starting."""

    tray: str
    fans: tuple[int, ...]
    reason: InvalidReason
    names: FanNames = NO_NAMES

    def line(self) -> str:
        """A text for people."""
        return f"{self.tray}: {self.names.labels(self.fans)}: {self.words}"

    @property
    def words(self) -> str:
        """The state, for people."""
        if self.reason != InvalidReason.STOPPED:
            return STARTING
        return STOPPED if len(self.fans) == 1 else STOPPED.replace("its", "their")

    def as_json(self) -> dict[str, object]:
        """JSON values for machines."""
        return {"tray": self.tray, "fans": list(self.fans), "state": self.reason.words}


def unjudged(model: SiteModel, states: Sequence[StageState]) -> list[Unjudged]:
    """The fans that are not judged now, and why. states: of the site's stages; one may be the reason."""
    found: list[Unjudged] = []
    for tray in model.trays:
        if late := _why_late(tray.name, states):
            found.append(Unjudged(tray.name, (), late))
            continue
        reasons = model.not_judged(tray.name)
        if reasons is None:
            found.append(Unjudged(tray.name, (), _why_no_scores(tray.name, states)))
            continue
        for reason, fans in reasons.items():
            why = REASONS.get(reason, reason.words)
            found.append(Unjudged(tray.name, () if len(fans) == tray.fans else fans, why, tray.names))
    return found


def at_rest(model: SiteModel) -> list[AtRest]:
    """The fans that are stopped or starting now; they are judged by whether they stand or turn as commanded."""
    return [
        AtRest(tray.name, fans, reason, tray.names)
        for tray in model.trays
        for reason, fans in model.at_rest(tray.name).items()
    ]


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
        """A line on each tray where other fans are not judged, or for another reason; or where all are judged now."""
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
    """Fans and reasons, without the figures in these, which change all the time."""
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
