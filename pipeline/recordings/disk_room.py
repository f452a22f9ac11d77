"""The limits on a part and on the disk space of recordings, and the deletions that keep them.

The oldest recordings are deleted when they are older than `keep_days`, when all recordings and clips of the folder
exceed `keep_share_of_disk`, or when the disk is nearly full. The last finished part stays.
"""

from __future__ import annotations

import logging
import math
import time
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path

from fantwin.pipeline.recordings.disk import Disk, least_free_bytes
from fantwin.pipeline.recordings.parts import RecordingParts
from fantwin.pipeline.recordings.recorder_config import (
    CLIPS_SHARE,
    PART_BYTES,
    PART_S,
    PARTS_WITHIN_LIMITS,
    RecorderConfig,
)
from fantwin.pipeline.recordings.records import RecordingError
from fantwin.pipeline.recordings.stored_recordings import Stored, StoredPart, StoredRecordings
from fantwin.schemas.units import NS_PER_S

DAY_NS = 86_400 * NS_PER_S
LEAST_PART_S = 1.0
AGED_S = 3600.0
"""between two parts that are deleted by age alone, unless a part has ended: the clock may be wrong"""
_LOG = logging.getLogger(__name__)


class DiskRoom:
    """Deletes what exceeds the limits, and says when the disk has too little free space."""

    def __init__(
        self, parts: RecordingParts, config: RecorderConfig, monotonic_s: Callable[[], float] = time.monotonic
    ) -> None:
        self._parts, self._config, self._monotonic_s = parts, config, monotonic_s
        self._aged_s = -math.inf
        """time of the last deletion by age alone, by `monotonic_s`"""
        self._spared: Path | None = None
        """the last finished part when the disk ran short: a pause ends one more, which must not cost this one"""
        self._logged = ""
        self.problem = ""
        """why the limits are not kept; empty if they are"""
        self._stored = Stored()
        self._limit_bytes = 0
        self._now_ns = 0
        self.counts: Counter[str] = Counter()

    @property
    def part_bytes(self) -> float:
        """The size at which a new part begins."""
        return min(PART_BYTES, (self._limit_bytes or math.inf) / PARTS_WITHIN_LIMITS)

    @property
    def part_s(self) -> float:
        """The time after which a new part begins."""
        kept_s = self._config.keep_days * 86_400 or math.inf
        return max(LEAST_PART_S, min(PART_S, kept_s / PARTS_WITHIN_LIMITS))

    def keep_limits(self, now_ns: int, *, has_ended_part: bool = False) -> None:
        """Delete what is too old, and the oldest that is too much; room for the part that is written is left.
        has_ended_part: a part has just ended, so that one may go by age.
        """
        self._now_ns, self.problem = now_ns, ""
        if has_ended_part:
            self._aged_s = -math.inf
        since_ns = now_ns - self._config.keep_days * DAY_NS if self._config.keep_days else -math.inf
        try:
            self._limit_bytes = round(self._parts.disk_bytes() * self._config.keep_share_of_disk)
            while len(parts := self._look()) > 1:
                if self._is_too_much():
                    self._delete(parts[0], self._too_much())
                elif parts[0].last_ns < since_ns and self._monotonic_s() - self._aged_s >= AGED_S:
                    self._delete(parts[0], f"older than {self._config.keep_days:g} days (recorder.keep_days)")
                    self._aged_s = self._monotonic_s()
                else:
                    break
        except RecordingError as error:
            self._report(error)

    def shortage(self, more_bytes: int) -> str:
        """Why the free space is not enough for `more_bytes`; empty if it is, or if a part was deleted for it.

        One part is deleted for each call, because its space may become free a little later. The last finished part is
        kept: if other programs fill the disk, no recording would be left otherwise.

        Raises:
            DiskError: the disk is gone, or its file system does not say its size.
        """
        wanted = least_free_bytes(self._parts.disk_bytes()) + more_bytes
        free = self._parts.free_bytes()
        if free >= wanted:
            self._spared = None
            return ""
        self.problem = ""
        try:
            parts = self._look()
            if len(parts) == 1:
                self._spared = parts[0].path
            if parts and parts[0].path != self._spared:
                self._delete(parts[0], "the disk runs short")
                return ""
        except RecordingError as error:
            self._report(error)
        return (
            f"{free / 1e6:,.1f} MB are free on the disk, but {wanted / 1e6:,.1f} MB are required, and "
            f"{self.problem or 'there is no older recording to delete: make room'}"
        )

    def notes(self) -> list[str]:
        """What recordings take of what they may, for people; empty where `problem` says why that is not known."""
        if self.problem or not self._limit_bytes:
            return []
        beyond = f"{self._too_much()}, and nothing more may be deleted: acknowledge alarms, or allow more"
        found = [usage(self._stored, self._limit_bytes, self._config, self._now_ns)]
        return [*found, beyond] if self._is_too_much() else found

    def _is_too_much(self) -> bool:
        """Clips count up to their share: those of other recorders may take more, and would push out every part."""
        stored = self._stored
        clips_bytes = min(stored.clips_bytes, self._limit_bytes * CLIPS_SHARE)
        return stored.finished_bytes + clips_bytes + max(stored.open_bytes, self.part_bytes) > self._limit_bytes

    def _too_much(self) -> str:
        return f"recordings and clips would exceed {in_bytes(self._limit_bytes)} (recorder.keep_share_of_disk)"

    def _look(self) -> Sequence[StoredPart]:
        self._stored = self._parts.stored()
        return self._stored.parts

    def _delete(self, part: StoredPart, why: str) -> None:
        self._parts.delete(part)
        self.counts["parts_deleted"] += 1
        _LOG.warning("%s, the oldest part, was deleted: %s", part.path.name, why)

    def _report(self, error: RecordingError) -> None:
        self.problem = str(error)
        if self.problem != self._logged:
            self._logged = self.problem
            _LOG.warning("%s", self.problem)


def usage(stored: Stored, limit_bytes: int, config: RecorderConfig, now_ns: int) -> str:
    """What recordings take of what they may, in words."""
    size = stored.finished_bytes + stored.clips_bytes + stored.open_bytes
    line = f"recordings: {in_bytes(size)} of {in_bytes(limit_bytes)}"
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
