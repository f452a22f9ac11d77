"""What operators said of the alarms in healthy recordings: which running may be learned from, and which not.

An alarm that was false is healthy running. One that was true is not: it is left out, with the time before it in which
the fault began. An alarm on which nobody has said anything counts as healthy, since whoever names a recording says so.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from fantwin.pipeline.recordings.dates import format_local, has_date
from fantwin.pipeline.recordings.rare_messages import rare_messages
from fantwin.pipeline.replay.offline.alarm_episodes import Episode, episodes
from fantwin.pipeline.site.alarm_history import AlarmHistory
from fantwin.schemas.enums import Feedback, InvalidReason
from fantwin.schemas.messages import Alarm, Prediction
from fantwin.schemas.units import NS_PER_S

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
        end_ns = _NEVER_NS if alarm.cleared_ns is None else alarm.cleared_ns
        return alarm.fan == self.fan and alarm.onset_ns <= self.to_t_ns and self.from_t_ns <= end_ns

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
        end_t_ns = _NEVER_NS if self.alarm.cleared_ns is None else self.alarm.cleared_ns
        from_t_ns = self.alarm.onset_ns - BEFORE_ALARM_NS
        return LeftOut(self.site, self.path, self.alarm.tray, self.alarm.fan, from_t_ns, end_t_ns)

    @property
    def line(self) -> str:
        """What becomes of it, for people; empty where nobody has said anything."""
        alarm, left_out = self.alarm, self.left_out
        if alarm.feedback == Feedback.NONE:
            return ""
        by = f" by {alarm.feedback_by}" if alarm.feedback_by else ""
        reason = f" ({alarm.feedback_reason})" if alarm.feedback_reason else ""
        what = f"{self.first_file}: {alarm.tray} fan {alarm.fan}: alarm of {format_local(alarm.onset_ns)}"
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
