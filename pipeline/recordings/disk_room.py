"""The room that a recorder leaves on the disk, and what it deletes to have it."""

from __future__ import annotations

import logging
from collections import Counter

from pipeline.recordings.clips.alarm_clips import AlarmClips
from pipeline.recordings.open_part import PartsFolder
from pipeline.recordings.recorder_config import RecorderConfig

_LOG = logging.getLogger(__name__)


class DiskRoom:
    """Says what is short, and deletes what may go if the configuration allows it."""

    def __init__(self, parts: PartsFolder, config: RecorderConfig, clips: AlarmClips | None) -> None:
        self._parts, self._config, self._clips = parts, config, clips
        self.counts: Counter[str] = Counter()

    def shortage(self, more_bytes: int) -> str:
        """Why the free space is not enough for `more_bytes`; empty if it is. Deletes the oldest part if allowed.

        One part at a time: the space may become free a little later. Raises RecordingError if the disk is gone.
        """
        wanted = self._config.min_free_bytes + more_bytes
        free = self._parts.free_bytes()
        if free >= wanted:
            return ""
        deleted = self._delete_oldest() if self._config.delete_oldest else ""
        if not deleted:
            return (
                f"{free / 1e6:,.1f} MB are free on the disk, but {wanted / 1e6:,.1f} MB are required "
                "(recorder.min_free_bytes): make room, or set recorder.delete_oldest"
            )
        _LOG.warning("%s deleted to make room (recorder.delete_oldest)", deleted)
        return ""

    def _delete_oldest(self) -> str:
        """Delete the oldest part, or an older clip whose alarms are acknowledged, and say which; empty: there is none.

        A part that a clip still needs goes last.
        """
        is_needed = False
        if self._clips:
            part, until_ns = self._parts.oldest_part(), self._clips.oldest_acknowledged_until_ns()
            is_needed = part is not None and self._clips.needs(part.last_ns)
            if until_ns is not None and (part is None or is_needed or until_ns <= part.last_ns):
                return f"{self._clips.delete_oldest_acknowledged()}: the oldest acknowledged clip was"
        deleted = self._parts.delete_oldest()
        if deleted is None:
            return ""
        self.counts["parts_deleted"] += 1
        if self._clips and is_needed:
            self._clips.part_deleted()
        return f"{deleted}: the oldest part was"
