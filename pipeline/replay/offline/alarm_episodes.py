"""Alarm episodes, each from raised to cleared, and the comparison of two lists of them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from typing import Any

from fantwin.schemas.enums import Feedback
from fantwin.schemas.messages import Alarm, Diagnosis
from fantwin.scoring.alarms.alarm_state import GIVES_FEEDBACK

_GIVES = dict(GIVES_FEEDBACK.values())
_Name = tuple[str, int, int]
"""of an alarm: tray, fan and onset"""
_Mark = tuple[int, Feedback, str, str]
"""place in the order, what it was, who says so, and why"""


@dataclass(frozen=True)
class Episode:
    """One alarm from raised to cleared; `cleared_ns` is None if it was active at the end."""

    tray: str
    fan: int
    raised_ns: int
    cleared_ns: int | None
    onset_ns: int
    severity: str
    """the highest"""
    residual_rad_s: float | None
    torque_balance_command: float | None
    """both when it was raised; None where unknown"""
    message: str
    causes: tuple[Diagnosis, ...]
    """the newest diagnosis"""
    feedback: Feedback = Feedback.NONE
    """the last one of an operator"""
    feedback_by: str = ""
    feedback_reason: str = ""

    def as_json(self) -> dict[str, Any]:
        """The JSON form; times on the recording's clock in ns."""
        return {
            "tray": self.tray,
            "fan": self.fan,
            "raised_ns": self.raised_ns,
            "cleared_ns": self.cleared_ns,
            "onset_ns": self.onset_ns,
            "severity": self.severity,
            "residual": self.residual_rad_s,
            "torque_balance": self.torque_balance_command,
            "message": self.message,
            "causes": [asdict(cause) for cause in self.causes],
            "feedback": self.feedback.name.lower(),
            "feedback_by": self.feedback_by,
            "feedback_reason": self.feedback_reason,
        }


def episodes(alarms: Iterable[Alarm]) -> list[Episode]:
    """The episodes of one or several trays, in the order they were raised.

    If a scorer restarts without a snapshot and raises an alarm that its predecessor raised and did not clear, both
    are one episode. Feedback may be later than the end of its episode; the episode was true if one of both was.
    """
    found: list[Episode] = []
    open_alarms: dict[tuple[str, int], list[Alarm]] = {}
    in_order = sorted(alarms, key=lambda alarm: alarm.t_ns)
    marks = _marks(in_order)
    for alarm in in_order:
        fan = (alarm.header.tray, alarm.fan)
        if alarm.active:
            open_alarms.setdefault(fan, []).append(alarm)
        elif fan in open_alarms:
            found.append(_episode([*open_alarms.pop(fan), alarm], alarm.t_ns, marks))
    found += [_episode(alarms_of_fan, None, marks) for alarms_of_fan in open_alarms.values()]
    return sorted(found, key=lambda episode: (episode.raised_ns, episode.tray, episode.fan))


@dataclass(frozen=True)
class AlarmDiff:
    """How two lists of episodes differ. An episode is in both if one of the same fan overlaps it in time."""

    gained: list[Episode]
    lost: list[Episode]
    kept: list[Episode]
    """in the new list, as they are there"""


def compare_episodes(now: list[Episode], before: list[Episode]) -> AlarmDiff:
    """The episodes that are gained, lost and kept compared with `before`."""
    kept = [episode for episode in now if any(_overlap(episode, other) for other in before)]
    return AlarmDiff(
        gained=[episode for episode in now if episode not in kept],
        lost=[other for other in before if not any(_overlap(other, episode) for episode in now)],
        kept=kept,
    )


def _overlap(one: Episode, other: Episode) -> bool:
    if (one.tray, one.fan) != (other.tray, other.fan):
        return False
    return _from(one) <= _to(other) and _from(other) <= _to(one)


def _from(episode: Episode) -> int:
    return episode.onset_ns


def _to(episode: Episode) -> int:
    return 2**63 if episode.cleared_ns is None else episode.cleared_ns


def _marks(in_order: list[Alarm]) -> dict[_Name, _Mark]:
    """The last feedback on each alarm, with its place in the order."""
    found: dict[_Name, _Mark] = {}
    for place, alarm in enumerate(in_order):
        fan = (alarm.header.tray, alarm.fan)
        if alarm.feedback != Feedback.NONE:
            found[*fan, alarm.onset_t_ns] = (place, alarm.feedback, alarm.feedback_by, alarm.feedback_reason)
        if feedback := _GIVES.get(alarm.transition):
            found[*fan, alarm.marked_onset_t_ns] = (place, feedback, alarm.operator_name, alarm.comment)
    return found


def _weight(mark: _Mark) -> tuple[bool, int]:
    """Of the marks on the alarms that are one episode: one that was true counts most, since nothing is learned from it,
    and then the last one."""
    place, feedback, _, _ = mark
    return feedback == Feedback.TRUE_ALARM, place


def _episode(messages: list[Alarm], cleared_ns: int | None, marks: Mapping[_Name, _Mark]) -> Episode:
    """messages: all of this episode, in order."""
    first = messages[0]
    fan = (first.header.tray, first.fan)
    marked = [mark for onset_ns in {each.onset_t_ns for each in messages} if (mark := marks.get((*fan, onset_ns)))]
    _, feedback, by, reason = max(marked, default=(0, Feedback.NONE, "", ""), key=_weight)
    return Episode(
        tray=first.header.tray,
        fan=first.fan,
        raised_ns=first.t_ns,
        cleared_ns=cleared_ns,
        onset_ns=first.onset_t_ns,
        severity=max(alarm.severity for alarm in messages).name.lower(),
        residual_rad_s=_known(first.residual_rad_s),
        torque_balance_command=_known(first.torque_balance_command),
        message=first.message,
        causes=next((alarm.causes for alarm in reversed(messages) if alarm.causes), ()),
        feedback=feedback,
        feedback_by=by,
        feedback_reason=reason,
    )


def _known(value: float) -> float | None:
    """None for 0.0, which a message holds where the value is unknown."""
    return value or None
