"""The limits on the disk space of recordings and clips, and the deletions that keep them.

The oldest recordings are deleted when they are older than `keep_days`, when all recordings and clips of the folder
exceed `keep_share_of_disk`, or when the disk is nearly full. A clip is deleted with the parts of its time, once its
alarms are acknowledged.
"""

from __future__ import annotations

import logging
import math
from collections import Counter
from pathlib import Path
from typing import NamedTuple

from pipeline.recordings.clips.alarm_clips import AlarmClips
from pipeline.recordings.disk import Disk
from pipeline.recordings.open_part import PartsFolder
from pipeline.recordings.recorder_config import PARTS_WITHIN_LIMITS, RecorderConfig
from pipeline.recordings.stored_recordings import Stored, StoredPart, StoredRecordings
from schemas.units import NS_PER_S

DAY_NS = 86_400 * NS_PER_S
_LOG = logging.getLogger(__name__)


class _Oldest(NamedTuple):
    """The part or clip that may be deleted next."""

    last_ns: int
    part: StoredPart | None
    """None: it is a clip"""
    is_needed: bool = False
    """a clip that is still to be cut needs this part"""


class DiskRoom:
    """Deletes what exceeds the limits, and says when the disk has too little free space."""

    def __init__(self, parts: PartsFolder, config: RecorderConfig, clips: AlarmClips | None) -> None:
        self._parts, self._config, self._clips = parts, config, clips
        self._stored = Stored()
        self._limit_bytes = 0
        self._now_ns = 0
        self._beyond = ""
        self.counts: Counter[str] = Counter()

    @property
    def part_bytes(self) -> float:
        """The size at which a new part begins."""
        return min(self._config.part_bytes or math.inf, (self._limit_bytes or math.inf) / PARTS_WITHIN_LIMITS)

    @property
    def part_s(self) -> float:
        """The time after which a new part begins."""
        kept_s = self._config.keep_days * 86_400 or math.inf
        return min(self._config.part_s or math.inf, kept_s / PARTS_WITHIN_LIMITS)

    def keep_limits(self, now_ns: int) -> None:
        """Delete recordings that are too old, then the oldest until the rest fits with the part that is being written.

        Raises:
            DiskError: the disk is gone.
        """
        self._now_ns = now_ns
        self._limit_bytes = round(self._parts.disk_bytes() * self._config.keep_share_of_disk)
        since_ns = now_ns - self._config.keep_days * DAY_NS if self._config.keep_days else -math.inf
        while True:
            oldest = self._oldest()
            is_old = oldest is not None and oldest.last_ns < since_ns
            if oldest is None or oldest.is_needed or not (is_old or self._is_too_much()):
                break
            why = f"older than {self._config.keep_days:g} days (recorder.keep_days)" if is_old else self._too_much()
            if not self._delete(oldest, why):
                break
        self._warn_of_what_is_kept(since_ns, is_all=oldest is None)

    def shortage(self, more_bytes: int) -> str:
        """Why the free space is not enough for `more_bytes`; empty if it is, or if a file was deleted for it.

        One file is deleted for each call, because its space may become free a little later. The last finished part is
        kept: if other programs fill the disk, no recording would be left otherwise.

        Raises:
            DiskError: the disk is gone.
        """
        wanted = self._config.min_free_bytes + more_bytes
        free = self._parts.free_bytes()
        if free >= wanted:
            return ""
        oldest = self._oldest()
        is_last = oldest is not None and oldest.part is not None and len(self._stored.parts) == 1
        if oldest and not is_last and self._delete(oldest, "the disk runs short (recorder.min_free_bytes)"):
            return ""
        return (
            f"{free / 1e6:,.1f} MB are free on the disk, but {wanted / 1e6:,.1f} MB are required "
            "(recorder.min_free_bytes), and there is no older recording to delete: make room"
        )

    def notes(self) -> list[str]:
        """The space and days that recordings take of their limits, for people; empty before the first look."""
        if not self._limit_bytes:
            return []
        return [usage(self._stored, self._limit_bytes, self._config, self._now_ns), *filter(None, [self._beyond])]

    def _is_too_much(self) -> bool:
        stored = self._stored
        return stored.finished_bytes + max(stored.open_bytes, self.part_bytes) > self._limit_bytes

    def _too_much(self) -> str:
        return f"recordings and clips would exceed {in_bytes(self._limit_bytes)} (recorder.keep_share_of_disk)"

    def _oldest(self) -> _Oldest | None:
        """The oldest part, or an older clip whose alarms are acknowledged. A part that a clip needs is deleted last."""
        self._stored = self._parts.stored()
        part = next(iter(self._stored.parts), None)
        is_needed = part is not None and self._clips is not None and self._clips.needs(part.last_ns)
        until_ns = self._clips.oldest_acknowledged_until_ns() if self._clips else None
        if until_ns is not None and (part is None or is_needed or until_ns <= part.last_ns):
            return _Oldest(until_ns, None)
        return _Oldest(part.last_ns, part, is_needed) if part else None

    def _delete(self, oldest: _Oldest, why: str) -> bool:
        """Delete it; False if that is not possible."""
        if oldest.part is None:
            assert self._clips
            deleted = self._clips.delete_oldest_acknowledged()
            _LOG.warning("clip %s, the oldest whose alarms are acknowledged, was deleted: %s", deleted, why)
            return True
        if not self._parts.delete(oldest.part):
            return False
        self.counts["parts_deleted"] += 1
        if self._clips and oldest.is_needed:
            self._clips.part_deleted()
        _LOG.warning("%s, the oldest part, was deleted: %s", oldest.part.path.name, why)
        return True

    def _warn_of_what_is_kept(self, since_ns: float, *, is_all: bool) -> None:
        """Warn once of files beyond the limits that may not be deleted. is_all: no file may be deleted."""
        before, self._beyond = self._beyond, ""
        if self._clips and (kept := self._clips.unacknowledged_before(since_ns)):
            size = sum(clip.size_bytes for clip in kept)
            self._beyond = (
                f"clips kept beyond {self._config.keep_days:g} days until their alarms are acknowledged: {len(kept)}, "
                f"{in_bytes(size)}"
            )
        elif is_all and self._is_too_much():
            self._beyond = f"{self._too_much()}, and nothing may be deleted: acknowledge alarms, or raise this limit"
        if self._beyond and not before:
            _LOG.warning("%s", self._beyond)


def usage(stored: Stored, limit_bytes: int, config: RecorderConfig, now_ns: int) -> str:
    """The space and days that recordings take of their limits, in words."""
    line = f"recordings: {in_bytes(stored.finished_bytes + stored.open_bytes)} of {in_bytes(limit_bytes)}"
    if not config.keep_days:
        return line
    days = (now_ns - stored.parts[0].last_ns) / DAY_NS if stored.parts else 0.0
    return f"{line}, {max(0.0, days):.1f} of {config.keep_days:g} days"


def usage_of(folder: Path, config: RecorderConfig, now_ns: int) -> str:
    """The usage of a folder, which need not exist.

    Raises:
        OSError, DiskError: it cannot be read.
    """
    existing = next(parent for parent in (folder, *folder.parents) if parent.exists())
    stored = StoredRecordings(folder).look() if existing == folder else Stored()
    return usage(stored, round(Disk(existing).size_bytes() * config.keep_share_of_disk), config, now_ns)


def in_bytes(size: float) -> str:
    """A size for people, with three digits."""
    for unit in ("bytes", "kB", "MB"):
        if size < 1000:
            return f"{size:.3g} {unit}"
        size /= 1000
    return f"{size:,.3g} GB" if size < 1000 else f"{size / 1000:,.3g} TB"
