"""What becomes of the alarms in healthy recordings, as operators marked them: for `fantwin calibrate`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fantwin.pipeline.cli.recordings_in_parallel import RecordingsInParallel
from fantwin.pipeline.recordings.clips.clip import require_no_clip
from fantwin.pipeline.recordings.contents import contents_of
from fantwin.pipeline.replay.offline.marked_alarms import LeftOut, MarkedAlarm, alarms_in, marked_alarms
from fantwin.schemas.enums import Feedback
from fantwin.schemas.messages import Alarm


@dataclass(frozen=True)
class MarkedRunning:
    """The alarms that concern some recordings."""

    alarms: tuple[MarkedAlarm, ...]

    @property
    def left_out(self) -> tuple[LeftOut, ...]:
        """Times of fans that are not learned from."""
        return tuple(span for each in self.alarms if (span := each.left_out) is not None)

    @property
    def lines(self) -> list[str]:
        """One for each alarm that is marked, and one for all others."""
        lines = [each.line for each in self.alarms if each.line]
        unmarked = sum(each.alarm.feedback == Feedback.NONE for each in self.alarms)
        if unmarked:
            are = "alarm in the recordings is" if unmarked == 1 else "alarms in the recordings are"
            lines.append(f"{unmarked} {are} not marked as true or false: used as healthy running")
        return lines

    def as_json(self) -> list[dict[str, Any]]:
        """For --json."""
        return [each.as_json() for each in self.alarms]


def marked_running(
    recordings: Sequence[Path], feedback: Sequence[Path], tray: str | None, pool: RecordingsInParallel
) -> MarkedRunning:
    """What operators said of the alarms in recordings. feedback: other files in which they said it. tray: the only one
    that is used.

    Raises:
        UserError: one cannot be read, or a recording is the clip of an alarm.
    """
    found = [*pool.map(_of_recording, recordings, "looking for alarms in recordings"), *map(_named, feedback)]
    alarms = [each for each in marked_alarms(found) if tray in (None, each.alarm.tray)]
    if feedback:
        spans = [(contents.first_ns or 0, contents.last_ns or 0) for contents in map(contents_of, recordings)]
        alarms = [each for each in alarms if each.first_file in recordings or _is_within(each, spans)]
    return MarkedRunning(tuple(alarms))


def _of_recording(path: Path) -> tuple[Path, list[tuple[str, Alarm]]]:
    require_no_clip(path, "and no picture of healthy running")
    return _named(path)


def _named(path: Path) -> tuple[Path, list[tuple[str, Alarm]]]:
    return path, alarms_in(path)


def _is_within(marked: MarkedAlarm, spans: Sequence[tuple[int, int]]) -> bool:
    alarm = marked.alarm
    return any(
        alarm.onset_ns <= last_ns and (alarm.cleared_ns is None or alarm.cleared_ns >= first_ns)
        for first_ns, last_ns in spans
    )
