"""An alarm clip: what it is called, what it holds, which alarms it is of; and the list of clips beside a recording."""

from __future__ import annotations

import json
from collections.abc import Collection, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from itertools import chain, count
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

from fantwin.pipeline.recordings.dates import format_utc
from fantwin.pipeline.recordings.reading import read_metadata
from fantwin.pipeline.recordings.records import RecordingError
from fantwin.pipeline.recordings.run_recordings import CLIPS
from fantwin.schemas.fan_names import fan_label
from fantwin.schemas.messages import Alarm
from fantwin.schemas.units import NS_PER_S

CLIP_KEY = "clip"
"""in the metadata of a clip: what `Clip.about` says, as JSON"""
CLIP_SNAPSHOT_KEY = "clip_snapshot_t_ns"
"""in the metadata of a clip that begins in the middle of a scorer's session: time of the snapshot in it from which the
session continues"""


@dataclass(frozen=True)
class ClipAlarm:
    """One alarm of a clip. Tray, fan and onset identify it."""

    fan: int
    onset_t_ns: int
    t_ns: int
    """when it was raised"""
    name: str = ""
    """of the fan"""
    acknowledged: bool = False

    def about(self) -> dict[str, Any]:
        """Which alarm it is, for machines."""
        return {"fan": self.fan, "name": self.name, "onset_t_ns": self.onset_t_ns, "t_ns": self.t_ns}


@dataclass(frozen=True)
class Clip:
    """A clip that is kept, or is due. Times are times of receipt."""

    name: str
    """of the file"""
    tray: str
    since_ns: int
    until_ns: int
    judged_since_ns: int
    """the scorer of a replay continues from a snapshot before this, so that its diagnosis has all samples it needs"""
    alarms: tuple[ClipAlarm, ...]
    is_due: bool = True
    """it is still to be cut, or to be cut again because what follows was not recorded yet"""
    size_bytes: int = 0
    """0: there is no file"""
    problem: str = ""
    """why it was not cut, or what it lacks"""

    @property
    def is_acknowledged(self) -> bool:
        """Whether all its alarms are: then it may be deleted."""
        return all(alarm.acknowledged for alarm in self.alarms)

    def with_acknowledged(self, alarm: Alarm) -> Clip:
        """After a message that says that nothing about this fan waits for an operator."""
        alarms = (
            replace(each, acknowledged=each.acknowledged or (each.fan == alarm.fan and each.t_ns <= alarm.t_ns))
            for each in self.alarms
        )
        return replace(self, alarms=tuple(alarms))

    def about(self) -> dict[str, Any]:
        """What the metadata of the file say of it."""
        of_alarms = [each.about() for each in self.alarms]
        return {"tray": self.tray, "since_ns": self.since_ns, "until_ns": self.until_ns, "alarms": of_alarms}


def clip_name(alarm: Alarm, taken: Collection[str]) -> str:
    """TRAY-FAN-UTCTIME.mcap; with a number if that is taken."""
    at = datetime.fromtimestamp(alarm.t_ns / NS_PER_S, UTC).strftime("%Y%m%dT%H%M%SZ")
    stem = f"{alarm.header.tray}-{alarm.fan}-{at}"
    names = chain([f"{stem}.mcap"], (f"{stem}-{number}.mcap" for number in count(2)))
    return next(name for name in names if name not in taken)


def clip_folder(recording: Path) -> Path:
    """Where the clips of a recording are. recording: its first part."""
    return recording.parent / CLIPS


def list_path(recording: Path) -> Path:
    """The list of the clips of a recording."""
    return clip_folder(recording) / f"{recording.stem}.json"


_LIST = TypeAdapter(dict[str, list[Clip]])


def clips_as_text(clips: Iterable[Clip]) -> bytes:
    """The content of a list of clips."""
    return _LIST.dump_json({"clips": list(clips)}, indent=1)


def clips_in(path: Path) -> list[Clip]:
    """The clips of a list, the oldest first; none where there is no list that can be read."""
    with suppress(OSError, ValueError, KeyError):
        return _LIST.validate_json(path.read_bytes())["clips"]
    return []


def kept_clips(folder: Path) -> list[Clip]:
    """The clips of all recordings of a folder that have a file, the newest first; of lists that cannot be read none."""
    found: list[Clip] = []
    for path in sorted(folder.glob("*.json")):
        named = [clip for clip in clips_in(path) if clip.size_bytes and Path(clip.name).name == clip.name]
        found += [clip for clip in named if (folder / clip.name).is_file()]
    return sorted(found, key=lambda clip: clip.since_ns, reverse=True)


def clip_lines(metadata: Mapping[str, str]) -> list[str]:
    """For people, what the metadata of a recording say of the alarms that it is a clip of; empty if it is none."""
    try:
        about = json.loads(metadata.get(CLIP_KEY, "null"))
        if about is None:
            return []
        tray = about["tray"]
        return [
            f"alarm clip: {tray} {fan_label(each['fan'], each['name'])}, raised {format_utc(each['t_ns'])}"
            for each in about["alarms"]
        ]
    except (ValueError, TypeError, KeyError, OverflowError):
        return ["alarm clip, whose metadata are damaged"]


def require_no_clip(path: Path, why: str) -> None:
    """Refuse the clip of an alarm where only whole recordings tell the truth.

    Raises:
        RecordingError: it is one, or the file cannot be opened or is not a recording.
    """
    if CLIP_KEY in read_metadata(path).metadata:
        raise RecordingError(f"{path}: this is the clip of an alarm, {why}: name the recordings that it was cut from")
