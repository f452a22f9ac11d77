"""The fans of a site at a glance: the state of each now, how near its score is to the limit, and whether it is judged.

A fan is in alarm as long as its alarm is active, whatever its newest sample says.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple

import numpy as np

from fantwin.pipeline.config.settings import FanConfig, TrayConfig
from fantwin.pipeline.site.trace import SILENT, state_codes, state_name
from fantwin.schemas.enums import FanState, InvalidReason, Transition
from fantwin.schemas.fields import LARGEST_ENUM_VALUE
from fantwin.schemas.messages import Alarm, Array, Score
from fantwin.scoring.alarms.alarm_state import is_silenced
from fantwin.scoring.alarms.alarm_text import words_now
from fantwin.scoring.alarms.unscored_monitor import JUDGED_AT_REST

NORMAL_LEVELS = 5
"""shades of a normal fan's cell, by its score"""
IS_AT_REST = np.isin(np.arange(256), JUDGED_AT_REST)
"""whether a fan with this `InvalidReason` is at rest, by its number: quicker than to look for each of an array"""
_NEVER_NS = -(1 << 62)
_SILENT_CODE = -1
_ALARM_CODE = state_codes(np.array([FanState.ALARM]), np.array([0]))
_HIGHEST_SCORE = 1e6


class Fan(NamedTuple):
    """A fan of a site; `number` counts from 0."""

    tray: str
    number: int

    def __str__(self) -> str:
        return f"{self.tray}/{self.number}"


class FanGroup(StrEnum):
    """The groups that all outputs sort fans into, the worst first."""

    ALARM = "alarm"
    SUSPECT = "suspect"
    NOT_JUDGED = "not_judged"
    SILENCED = "silenced"
    AT_REST = "at_rest"
    NORMAL = "normal"


class ShownClass(NamedTuple):
    """What a cell of a class shows: name and group. now: what a fan with an alarm does now; empty: nothing to say."""

    name: str
    group: FanGroup
    now: str


@dataclass(frozen=True)
class FanNow:
    """What is known about one fan now.

    Attributes:
        state: in words.
        score: 1 is at the limit; NaN if the newest sample is not scored.
        since_t_ns: time of the sample at which the state began; of an alarm, its onset.
    """

    fan: Fan
    state: str
    group: FanGroup
    score: float
    since_t_ns: int
    about: FanConfig = FanConfig()
    """its name and place"""


_OF_STATE = {
    FanState.NORMAL: FanGroup.NORMAL,
    FanState.SUSPECT: FanGroup.SUSPECT,
    FanState.ALARM: FanGroup.ALARM,
    FanState.RETURNING: FanGroup.ALARM,
    FanState.STOPPED: FanGroup.AT_REST,
    FanState.STARTING: FanGroup.AT_REST,
}
"""of a fan whose alarm is not active by its messages; others are not judged"""
_BARE_ALARM = (FanState.NORMAL, FanState.SUSPECT, FanState.ALARM)
"""states that add nothing to an active alarm"""


def _shown_classes() -> tuple[ShownClass, ...]:
    """The classes of fans, then those of fans in alarm, then those of fans whose alarm is silenced. Each: normal by its
    score, then the states, a state of a newer version, unknown for each reason, and silent."""
    step = 1 / NORMAL_LEVELS
    normal = [f"normal, score {level * step:.1f} to {(level + 1) * step:.1f}" for level in range(NORMAL_LEVELS)]
    bare: list[ShownClass] = []
    active: list[ShownClass] = []
    unknown = [state_name(FanState.UNKNOWN, reason) for reason in InvalidReason]
    for number, name in enumerate([*normal, *(state.words for state in FanState), "unknown state", *unknown, SILENT]):
        value = number - NORMAL_LEVELS
        state = FanState.NORMAL if value < 0 else FanState(value) if value < len(FanState) else FanState.UNKNOWN
        now = words_now(state)
        bare.append(ShownClass(name, _OF_STATE.get(state, FanGroup.NOT_JUDGED), now))
        added = "" if state in _BARE_ALARM else f", now {now.partition(' (')[0]}" if now else f", {name}"
        active.append(ShownClass(f"alarm{added}", FanGroup.ALARM, now))
    silenced = (each._replace(name=f"{each.name} (silenced)", group=FanGroup.SILENCED) for each in active)
    return (*bare, *active, *silenced)


SHOWN_CLASSES = _shown_classes()
_OF_REASON = np.full(256, NORMAL_LEVELS + FanState.UNKNOWN)
"""the class of a fan whose state is unknown, by the number of its `InvalidReason`"""
_OF_REASON[list(InvalidReason)] = NORMAL_LEVELS + len(FanState) + 1 + np.arange(len(InvalidReason))
_GROUPS = np.array([list(FanGroup).index(each.group) for each in SHOWN_CLASSES])


class Fleet:
    """The newest state of every fan. All arrays are (fans,), tray after tray in the order of the configuration."""

    def __init__(self, trays: Sequence[TrayConfig]) -> None:
        self.fans = [Fan(tray.name, number) for tray in trays for number in range(tray.fans)]
        self._about = [fan for tray in trays for fan in tray.fan]
        ends = np.cumsum([tray.fans for tray in trays])
        self._of_tray = {
            tray.name: slice(int(end) - tray.fans, int(end)) for tray, end in zip(trays, ends, strict=True)
        }
        count = len(self.fans)
        self._codes = np.full(count, _SILENT_CODE, np.int64)
        """of `state_codes`"""
        self._reasons = np.zeros(count, np.uint8)
        """`InvalidReason` of the newest sample"""
        self._score = np.full(count, np.nan, np.float32)
        self._since_t_ns = np.zeros(count, np.int64)
        self._onset_t_ns = np.full(count, _NEVER_NS)
        """of the active alarm, as its messages say"""
        self._silenced = np.zeros(count, np.bool_)
        self._judged_s = np.full(count, -np.inf)
        """when each was judged last, of a monotonic clock"""

    def update(self, tray: str, score: Score, now_s: float) -> None:
        """Take the last sample of a tray, in a score with the right number of fans. now_s: of a monotonic clock.

        It needs the columns state, invalid_reason, valid and score.
        """
        of_tray = self._of_tray[tray]
        self._change(of_tray, state_codes(score.state[-1], score.invalid_reason[-1]), int(score.t_ns[-1]))
        self._reasons[of_tray] = score.invalid_reason[-1]
        self._score[of_tray] = score.score[-1]
        judged = (score.valid | IS_AT_REST[score.invalid_reason]).any(axis=0)
        self._judged_s[of_tray][judged] = now_s

    def silence(self, tray: str, since_t_ns: int) -> None:
        """A tray has not sent a sample for long; the last was of `since_t_ns`."""
        of_tray = self._of_tray[tray]
        self._change(of_tray, np.full(of_tray.stop - of_tray.start, _SILENT_CODE), since_t_ns)
        self._reasons[of_tray] = InvalidReason.NONE
        self._score[of_tray] = np.nan

    def add_alarm(self, alarm: Alarm) -> None:
        """Take the state of an alarm.

        A fan whose alarm is raised is in alarm at once: its next sample may be a second away.
        """
        index = self.index(Fan(alarm.header.tray, alarm.fan))
        self._onset_t_ns[index] = alarm.onset_t_ns if alarm.active else _NEVER_NS
        self._silenced[index] = is_silenced(alarm)
        if alarm.active and alarm.transition == Transition.RAISED and self._states()[index] > FanState.UNKNOWN:
            self._change(slice(index, index + 1), _ALARM_CODE, alarm.t_ns)

    def classes(self) -> Array:
        """The class of each fan's cell, (fans,) uint8, an index into `SHOWN_CLASSES`."""
        state = np.maximum(self._codes, 0) // (LARGEST_ENUM_VALUE + 1)
        known = np.minimum(state, len(FanState)) + NORMAL_LEVELS
        level = (np.nan_to_num(self._score, nan=0.0, posinf=1.0, neginf=0.0) * NORMAL_LEVELS).clip(0, NORMAL_LEVELS - 1)
        bare = np.where(state == FanState.NORMAL, level, known)
        bare = np.where(state == FanState.UNKNOWN, _OF_REASON[self._reasons], bare)
        count, in_alarm = len(SHOWN_CLASSES) // 3, self.in_alarm()
        bare = np.where(self._codes < 0, count - 1, bare)
        return (bare + count * in_alarm + count * (in_alarm & self._silenced)).astype(np.uint8)

    def counts(self) -> dict[FanGroup, int]:
        """How many fans are in each group."""
        found = np.bincount(_GROUPS[self.classes()], minlength=len(FanGroup))
        return dict(zip(FanGroup, found.tolist(), strict=True))

    def in_alarm(self) -> Array:
        """Whether each fan is in alarm, (fans,): its newest sample or its last alarm message says so."""
        state = self._states()
        return (state == FanState.ALARM) | (state == FanState.RETURNING) | (self._onset_t_ns != _NEVER_NS)

    def scores(self) -> Array:
        """The score of each fan, (fans,) float32: 1 is at the limit; NaN if the newest sample is not scored."""
        return self._score.copy()

    def alarms(self) -> list[Fan]:
        """The fans in alarm whose alarm is not silenced, the highest score first."""
        indexes = np.flatnonzero(self.in_alarm() & ~self._silenced)
        return [self.fans[index] for index in indexes[np.argsort(-np.nan_to_num(self._score[indexes]), kind="stable")]]

    def every_fan(self) -> list[FanNow]:
        """All fans, the worst first: in alarm, suspect, in an alarm that is silenced, the others by their score, and
        those that are not judged."""
        in_alarm = self.in_alarm()
        rank = np.where(self._states() == FanState.SUSPECT, 2, 0)
        rank[in_alarm] = np.where(self._silenced[in_alarm], 1, 3)
        score = np.nan_to_num(self._score, nan=0.0, posinf=_HIGHEST_SCORE, neginf=0.0).clip(0.0, _HIGHEST_SCORE)
        listed = (self._states() > FanState.UNKNOWN) | in_alarm
        order = np.lexsort((np.where(listed, -score, 0.0), -rank, ~listed)).tolist()
        classes = self.classes().tolist()
        return [self._now(index, bool(in_alarm[index]), classes[index]) for index in order]

    def fan_now(self, fan: Fan) -> FanNow:
        """One fan of the site."""
        index = self.index(fan)
        return self._now(index, bool(self.in_alarm()[index]), int(self.classes()[index]))

    def index(self, fan: Fan) -> int:
        """The index of a fan of the site."""
        return self._of_tray[fan.tray].start + fan.number

    def not_judged(self, tray: str, since_s: float) -> dict[InvalidReason, tuple[int, ...]]:
        """Fans of a tray that were not judged since then, by the reason of the newest sample."""
        of_tray = self._of_tray[tray]
        fans = np.flatnonzero(self._judged_s[of_tray] < since_s)
        reasons = self._reasons[of_tray][fans]
        return {InvalidReason(each): tuple(fans[reasons == each].tolist()) for each in np.unique(reasons).tolist()}

    def at_rest(self, tray: str) -> dict[InvalidReason, tuple[int, ...]]:
        """The fans of a tray that are stopped or starting, which are judged all the same."""
        reasons = self._reasons[self._of_tray[tray]]
        found = {reason: tuple(np.flatnonzero(reasons == reason).tolist()) for reason in JUDGED_AT_REST}
        return {reason: fans for reason, fans in found.items() if fans}

    def words_now(self, fan: Fan) -> str:
        """Words for a fan that is stopped, starting or like a healthy one again; empty: it is none of these."""
        index = self.index(fan)
        return words_now(int(self._states()[index]), int(self._reasons[index]))

    def _now(self, index: int, in_alarm: bool, cell: int) -> FanNow:
        code, since_t_ns = int(self._codes[index]), int(self._since_t_ns[index])
        name = SILENT if code < 0 else state_name(*divmod(code, LARGEST_ENUM_VALUE + 1))
        onset_t_ns = int(self._onset_t_ns[index])
        if in_alarm and onset_t_ns != _NEVER_NS:
            since_t_ns = onset_t_ns
        if in_alarm and not name.startswith((FanState.ALARM.words, FanState.RETURNING.words)):
            words = words_now(code // (LARGEST_ENUM_VALUE + 1))
            name = f"alarm, now {words}" if words else f"alarm, {name}"
        group = SHOWN_CLASSES[cell].group
        if group == FanGroup.SILENCED:
            name += " (silenced)"
        return FanNow(self.fans[index], name, group, float(self._score[index]), since_t_ns, self._about[index])

    def _change(self, of_tray: slice, codes: Array, t_ns: int) -> None:
        changed = self._codes[of_tray] != codes
        self._since_t_ns[of_tray][changed] = t_ns
        self._codes[of_tray] = codes

    def _states(self) -> Array:
        """(fans,), -1 where silent."""
        return self._codes // (LARGEST_ENUM_VALUE + 1)


def last_sample(score: Score, columns: Sequence[str]) -> Score:
    """The last sample of a score with these columns. It is a copy: a view would keep the whole message in memory."""
    values = {name: getattr(score, name)[-1:].copy() for name in ("t_ns", *columns)}
    return Score(header=score.header, fans=score.fans, period_ns=score.period_ns, **values)
