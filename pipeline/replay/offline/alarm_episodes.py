"""Alarm episodes, each from raised to cleared, the comparison of two lists of them, and what operators said of them.

What operators said of the alarms in healthy recordings decides which running may be learned from. An alarm that was
false is healthy running. One that was true is not: it is left out, with the time before it in which the fault began. An
alarm on which nobody has said anything counts as healthy, since whoever names a recording says so.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from fantwin.pipeline.recordings.dates import format_local, has_date
from fantwin.pipeline.recordings.indexed import rare_messages
from fantwin.pipeline.site.alarm_history import AlarmHistory
from fantwin.schemas.enums import Feedback, InvalidReason
from fantwin.schemas.fan_names import fan_label
from fantwin.schemas.messages import Alarm, Diagnosis, Prediction
from fantwin.schemas.units import NS_PER_S
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
    name: str = ""
    """name of the fan"""

    @property
    def label(self) -> str:
        """See Alarm."""
        return fan_label(self.fan, self.name)

    @property
    def end_ns(self) -> int:
        """When it was cleared; later than all times if it was not."""
        return _NEVER_NS if self.cleared_ns is None else self.cleared_ns

    def as_json(self) -> dict[str, Any]:
        """The JSON form; times on the recording's clock in ns."""
        found = asdict(self)
        residual, balance = found.pop("residual_rad_s"), found.pop("torque_balance_command")
        return found | {
            "residual": residual,
            "torque_balance": balance,
            "causes": list(found["causes"]),
            "feedback": self.feedback.name.lower(),
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


def compare_episodes(now: list[Episode], before: list[Episode]) -> dict[str, list[Episode]]:
    """The episodes that are `gained`, `lost` and `kept` compared with `before`: kept are those of which one of the same
    fan overlaps in time."""
    kept = [episode for episode in now if any(_overlap(episode, other) for other in before)]
    return {
        "gained": [episode for episode in now if episode not in kept],
        "lost": [other for other in before if not any(_overlap(other, episode) for episode in now)],
        "kept": kept,
    }


def _overlap(one: Episode, other: Episode) -> bool:
    is_same_fan = (one.tray, one.fan) == (other.tray, other.fan)
    return is_same_fan and one.onset_ns <= other.end_ns and other.onset_ns <= one.end_ns


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
        name=first.fan_name,
    )


def _known(value: float) -> float | None:
    """None for 0.0, which a message holds where the value is unknown."""
    return value or None


BEFORE_ALARM_NS = 600 * NS_PER_S
"""a fault begins before its alarm: so long before the onset is left out, too, as a learner holds back"""
FILE_OF_GATEWAY = ".sqlite"
_NEVER_NS = 2**63 - 1
_FIRST = -(2**62)
"""number of a transition: those from recordings are below 0"""


@dataclass(frozen=True)
class LeftOut:
    """A time of a fan that is not learned from. site: empty for any. path: of the only recording that is meant; None:
    all of the site."""

    site: str
    path: Path | None
    tray: str
    fan: int
    from_t_ns: int
    to_t_ns: int

    def has(self, alarm: Episode) -> bool:
        """Whether an alarm of these trays overlaps it."""
        return alarm.fan == self.fan and alarm.onset_ns <= self.to_t_ns and self.from_t_ns <= alarm.end_ns

    def length_ns(self, first_t_ns: int, last_t_ns: int) -> int:
        """How much of it lies between two times."""
        return max(0, min(self.to_t_ns, last_t_ns) - max(self.from_t_ns, first_t_ns))


@dataclass(frozen=True)
class MarkedAlarm:
    """An alarm, the site or the recording that it belongs to, and the first file that has it."""

    site: str
    path: Path | None
    alarm: Episode
    first_file: Path

    @property
    def left_out(self) -> LeftOut | None:
        """What is left out because of it; None: nothing."""
        if self.alarm.feedback != Feedback.TRUE_ALARM:
            return None
        from_t_ns = self.alarm.onset_ns - BEFORE_ALARM_NS
        return LeftOut(self.site, self.path, self.alarm.tray, self.alarm.fan, from_t_ns, self.alarm.end_ns)

    @property
    def line(self) -> str:
        """What becomes of it, for people; empty where nobody has said anything."""
        alarm, left_out = self.alarm, self.left_out
        if alarm.feedback == Feedback.NONE:
            return ""
        by = f" by {alarm.feedback_by}" if alarm.feedback_by else ""
        reason = f" ({alarm.feedback_reason})" if alarm.feedback_reason else ""
        what = f"{self.first_file}: {alarm.tray} {alarm.label}: alarm of {format_local(alarm.onset_ns)}"
        marked = f"{what}, marked as a {alarm.feedback.words}{by}{reason}"
        if left_out is None:
            return f"{marked}: used as healthy running"
        until = "the end" if alarm.cleared_ns is None else format_local(alarm.cleared_ns)
        return f"{marked}: left out, from {BEFORE_ALARM_NS // NS_PER_S // 60} min before it until {until}"

    def as_json(self) -> dict[str, Any]:
        """The same for machines."""
        return {**self.alarm.as_json(), "recording": str(self.first_file), "is_left_out": self.left_out is not None}


def alarms_in(path: Path) -> list[tuple[str, Alarm]]:
    """The messages about alarms in a recording, or in a history of alarms, each with its site, empty if not known.

    Raises:
        UserError: it cannot be read.
    """
    if path.suffix != FILE_OF_GATEWAY:
        found = ((envelope.key.split("/")[1], envelope.message) for envelope in rare_messages(path, "alarm"))
        return [(site, message) for site, message in found if isinstance(message, Alarm)]
    history = AlarmHistory(path, read_only=True)
    try:
        return [("", alarm) for _, alarm in history.after(_FIRST, -1)]
    finally:
        history.close()


def marked_alarms(files: Iterable[tuple[Path, Sequence[tuple[str, Alarm]]]]) -> list[MarkedAlarm]:
    """The alarms of files, in the order they were raised. files: each with what `alarms_in` returns.

    Feedback may be in another file than its alarm. Where times are dates, an alarm belongs to all recordings of its
    site, since one may lie within it; else, as in a simulation, times of two recordings have nothing in common.
    """
    found: dict[tuple[str, Path | None], dict[tuple[str, str, int], Alarm]] = {}
    first_files: dict[tuple[str, int, int], Path] = {}
    for path, alarms in files:
        for site, alarm in alarms:
            of = (site, None) if has_date(alarm.t_ns) else (site, path)
            header = alarm.header
            found.setdefault(of, {})[header.producer, header.tray, header.sequence] = alarm
            first_files.setdefault((header.tray, alarm.fan, alarm.onset_t_ns), path)
    if ("", None) in found:  # of a gateway, which has one site
        of_gateway = found.pop(("", None))
        dated = [of for of in found if of[1] is None]
        for of in dated or [("", None)]:
            found.setdefault(of, {}).update(of_gateway)
    marked = [
        MarkedAlarm(site, path, each, first_files[each.tray, each.fan, each.onset_ns])
        for (site, path), messages in found.items()
        for each in episodes(messages.values())
    ]
    return sorted(marked, key=lambda each: each.alarm.raised_ns)


def without(prediction: Prediction, spans: Sequence[LeftOut]) -> Prediction:
    """A block of predictions in which these times of its fans are a gap. spans: of its tray."""
    gap = np.zeros(prediction.valid.shape, np.bool_)
    for span in spans:
        if span.fan < prediction.fans:
            gap[:, span.fan] |= (prediction.t_ns >= span.from_t_ns) & (prediction.t_ns <= span.to_t_ns)
    if not gap.any():
        return prediction
    missing = prediction.reading_missing
    return replace(
        prediction,
        valid=prediction.valid & ~gap,
        invalid_reason=np.where(gap, np.uint8(InvalidReason.GAP), prediction.invalid_reason),
        reading_missing=missing & ~gap if len(missing) else missing,
    )


def concerning(spans: Iterable[LeftOut], path: Path, site: str, tray: str) -> list[LeftOut]:
    """Those that are about a tray of a recording."""
    return [each for each in spans if each.tray == tray and each.site in ("", site) and each.path in (None, path)]
