"""The fans of a site at a glance: the newest state of each, how near its score is to the limit, and the worst fans."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from fantwin.pipeline.config.models import TrayConfig
from fantwin.pipeline.site.trace import SILENT, state_codes, state_name
from fantwin.schemas.enums import FanState, Transition
from fantwin.schemas.fields import LARGEST_ENUM_VALUE
from fantwin.schemas.messages import Alarm, Array, Score
from fantwin.scoring.alarms.alarm_flags import is_silenced
from fantwin.scoring.alarms.words_now import words_now

FLEET_COLUMNS = ("state", "invalid_reason", "score")
"""the columns of a score that a fleet is made of"""
NORMAL_LEVELS = 5
"""shades of a normal fan's cell, by its score"""
_NEVER_NS = -(1 << 62)
_SILENT_CODE = -1
_ALARM_CODE = state_codes(np.array([FanState.ALARM]), np.array([0]))
_ALARM, _SUSPECT, _SILENCED, _OTHER = 3, 2, 1, 0
_HIGHEST_SCORE = 1e6


class Fan(NamedTuple):
    """A fan of a site; `number` counts from 0."""

    tray: str
    number: int

    def __str__(self) -> str:
        return f"{self.tray}/{self.number}"


@dataclass(frozen=True)
class FanNow:
    """What is known about one fan now.

    Attributes:
        state: in words.
        score: 1 is at the limit; NaN if the newest sample is not scored.
        since_t_ns: time of the sample at which the state began; of an alarm, its onset.
        is_in_alarm: an alarm is active; an operator may have silenced it.
    """

    fan: Fan
    state: str
    score: float
    since_t_ns: int
    is_in_alarm: bool
    is_silenced: bool = False


@dataclass(frozen=True)
class UnscoredFans:
    """The fans that are not judged for one reason: how many, of which trays, and since when the first of them."""

    reason: str
    fans: int
    trays: Sequence[str]
    since_t_ns: int


class Fleet:
    """The newest state of every fan. All arrays are (fans,), tray after tray in the order of the configuration."""

    def __init__(self, trays: Sequence[TrayConfig], *, has_all_alarms: bool = False) -> None:
        """has_all_alarms: all messages about alarms arrive, also those of before the start: what is active by them is
        active, whatever samples say."""
        self._has_all_alarms = has_all_alarms
        self.fans = [Fan(tray.name, number) for tray in trays for number in range(tray.fans)]
        ends = np.cumsum([tray.fans for tray in trays])
        self._of_tray = {
            tray.name: slice(int(end) - tray.fans, int(end)) for tray, end in zip(trays, ends, strict=True)
        }
        count = len(self.fans)
        self._codes = np.full(count, _SILENT_CODE, np.int64)
        """of `state_codes`"""
        self._score = np.full(count, np.nan, np.float32)
        self._since_t_ns = np.zeros(count, np.int64)
        self._onset_t_ns = np.full(count, _NEVER_NS)
        """of the active alarm, as its messages say"""
        self._silenced = np.zeros(count, np.bool_)

    def update(self, newest: Score) -> None:
        """Take the last sample of a score of a known tray with the right number of fans. It needs `FLEET_COLUMNS`."""
        of_tray = self._of_tray[newest.header.tray]
        self._change(of_tray, state_codes(newest.state[-1], newest.invalid_reason[-1]), int(newest.t_ns[-1]))
        self._score[of_tray] = newest.score[-1]

    def silence(self, tray: str, since_t_ns: int) -> None:
        """A tray has not sent a sample for long; the last was of `since_t_ns`."""
        of_tray = self._of_tray[tray]
        self._change(of_tray, np.full(of_tray.stop - of_tray.start, _SILENT_CODE), since_t_ns)
        self._score[of_tray] = np.nan

    def add_alarm(self, alarm: Alarm) -> None:
        """Take the state of an alarm. An alarm of a fan that the tray does not have is ignored.

        A fan whose alarm is raised is in alarm at once: its next sample may be a second away.
        """
        of_tray = self._of_tray[alarm.header.tray]
        index = of_tray.start + alarm.fan
        if index < of_tray.stop:
            self._onset_t_ns[index] = alarm.onset_t_ns if alarm.active else _NEVER_NS
            self._silenced[index] = is_silenced(alarm)
            if alarm.active and alarm.transition == Transition.RAISED and self._judged()[index]:
                self._change(slice(index, index + 1), _ALARM_CODE, alarm.t_ns)

    def classes(self) -> Array:
        """The class of each fan's cell, (fans,) uint8, an index into `class_names`."""
        state = np.maximum(self._codes, 0) // (LARGEST_ENUM_VALUE + 1)
        known = np.minimum(state, len(FanState)) + NORMAL_LEVELS
        level = (np.nan_to_num(self._score, nan=0.0, posinf=1.0, neginf=0.0) * NORMAL_LEVELS).clip(0, NORMAL_LEVELS - 1)
        classes = np.where(state == FanState.NORMAL, level, known)
        return np.where(self._codes < 0, len(class_names()) - 1, classes).astype(np.uint8)

    def in_alarm(self) -> Array:
        """Whether each fan is in alarm, (fans,). If its newest sample does not say it, its last alarm message does."""
        state = self._states()
        says_it = (state > FanState.UNKNOWN) & (state < FanState.STOPPED) & (not self._has_all_alarms)
        is_active = (state == FanState.ALARM) | (state == FanState.RETURNING)
        return is_active | (~says_it & (self._onset_t_ns != _NEVER_NS))

    def silenced(self) -> Array:
        """Whether an operator has silenced the alarm of each fan, (fans,)."""
        return self._silenced.copy()

    def worst(self, most: int) -> list[FanNow]:
        """The worst fans first: in alarm, suspect, in an alarm that is silenced, and then all others by their score.

        Fans that are not judged and not in alarm are left out.
        """
        in_alarm = self.in_alarm()
        listed = self._judged() | in_alarm
        rank = np.full(len(self.fans), _OTHER)
        rank[self._states() == FanState.SUSPECT] = _SUSPECT
        rank[in_alarm] = np.where(self._silenced[in_alarm], _SILENCED, _ALARM)
        score = np.nan_to_num(self._score, nan=0.0, posinf=_HIGHEST_SCORE, neginf=0.0).clip(0.0, _HIGHEST_SCORE)
        order = np.lexsort((-score, -rank, ~listed))[:most]
        return [self._now(int(index), bool(in_alarm[index])) for index in order if listed[index]]

    def every_fan(self) -> list[FanNow]:
        """All fans, the worst first, those that are not judged and not in alarm last."""
        order = [self.index(each.fan) for each in self.worst(len(self.fans))]
        listed = set(order)
        order += [index for index in range(len(self.fans)) if index not in listed]
        in_alarm = self.in_alarm()
        return [self._now(index, bool(in_alarm[index])) for index in order]

    def fan_now(self, fan: Fan) -> FanNow:
        """One fan of the site."""
        index = self.index(fan)
        return self._now(index, bool(self.in_alarm()[index]))

    def scores(self) -> Array:
        """The score of each fan, (fans,) float32: 1 is at the limit; NaN if the newest sample is not scored."""
        return self._score.copy()

    def alarms(self) -> list[Fan]:
        """The fans in alarm whose alarm is not silenced, the highest score first."""
        indexes = np.flatnonzero(self.in_alarm() & ~self._silenced)
        return [self.fans[index] for index in indexes[np.argsort(-np.nan_to_num(self._score[indexes]), kind="stable")]]

    def index(self, fan: Fan) -> int:
        """The index of a fan of the site."""
        return self._of_tray[fan.tray].start + fan.number

    def counts(self) -> dict[str, int]:
        """How many fans are in alarm, suspect and not judged."""
        in_alarm = self.in_alarm()
        return {
            "in alarm": int(in_alarm.sum()),
            "suspect": int((self._states() == FanState.SUSPECT).sum()),
            "not judged": int((~self._judged() & ~in_alarm).sum()),
        }

    def unscored(self) -> list[UnscoredFans]:
        """The fans that are neither judged nor in alarm, by reason, the most frequent first."""
        left_out = ~self._judged() & ~self.in_alarm()
        groups: list[UnscoredFans] = []
        for code in np.unique(self._codes[left_out]).tolist():
            indexes = np.flatnonzero(left_out & (self._codes == code))
            trays = list(dict.fromkeys(self.fans[index].tray for index in indexes))
            groups.append(UnscoredFans(self._name(code), len(indexes), trays, int(self._since_t_ns[indexes].min())))
        return sorted(groups, key=lambda group: -group.fans)

    def _now(self, index: int, in_alarm: bool) -> FanNow:
        since_t_ns, name = int(self._since_t_ns[index]), self._name(int(self._codes[index]))
        onset_t_ns = int(self._onset_t_ns[index])
        if in_alarm and onset_t_ns != _NEVER_NS:
            since_t_ns = onset_t_ns
        is_silenced = bool(self._silenced[index])
        if in_alarm and not name.startswith((FanState.ALARM.words, FanState.RETURNING.words)):
            words = words_now(int(self._states()[index]))
            name = f"alarm, now {words}" if words else f"alarm, {name}"
        if in_alarm and is_silenced:
            name += " (silenced)"
        return FanNow(self.fans[index], name, float(self._score[index]), since_t_ns, in_alarm, is_silenced)

    def _change(self, of_tray: slice, codes: Array, t_ns: int) -> None:
        changed = self._codes[of_tray] != codes
        self._since_t_ns[of_tray][changed] = t_ns
        self._codes[of_tray] = codes

    def _states(self) -> Array:
        """(fans,), -1 where silent."""
        return self._codes // (LARGEST_ENUM_VALUE + 1)

    def _judged(self) -> Array:
        return self._states() > FanState.UNKNOWN

    def _name(self, code: int) -> str:
        return SILENT if code < 0 else state_name(*divmod(code, LARGEST_ENUM_VALUE + 1))


def class_names() -> list[str]:
    """What the classes of cells mean: normal by its score, then the states, a state of a newer version, and silent."""
    step = 1 / NORMAL_LEVELS
    normal = [f"normal, score {level * step:.1f} to {(level + 1) * step:.1f}" for level in range(NORMAL_LEVELS)]
    return [*normal, *(state.words for state in FanState), "unknown state", SILENT]


def last_sample(score: Score, columns: Sequence[str]) -> Score:
    """The last sample of a score with these columns. It is a copy: a view would keep the whole message in memory."""
    values = {name: getattr(score, name)[-1:].copy() for name in ("t_ns", *columns)}
    return Score(header=score.header, fans=score.fans, period_ns=score.period_ns, **values)
