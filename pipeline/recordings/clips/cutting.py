"""Cutting an alarm clip from the parts of a recording.

A clip has all that was recorded of its tray, and the health of all stages, from its beginning to its end. What comes
before makes it a recording that decides the same again: a snapshot of the scorer, the twin in force, what was made
since that snapshot, and the raw samples of CLOCK_MARGIN_S more, so that the device's clock and the twin's state are
settled when the scorer continues. Where snapshots are rare, at slow rates, the clip goes back LEAD_S at most.

A clip is written whole or not at all: it gets its name once it is on the disk.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from fantwin.pipeline.recordings.clips.clip import CLIP_KEY, CLIP_SNAPSHOT_KEY, Clip, clip_folder
from fantwin.pipeline.recordings.clips.tracker import SET_BACK_NS, CutResult
from fantwin.pipeline.recordings.disk import DiskError, refused
from fantwin.pipeline.recordings.excerpts import CLOCK_MARGIN_S
from fantwin.pipeline.recordings.indexed import IndexedRecording
from fantwin.pipeline.recordings.parts import part_files
from fantwin.pipeline.recordings.reading import NAMES_KEY, TACHO_KEY, RecordingMetadata, read_metadata
from fantwin.pipeline.recordings.records import (
    CORRUPT_DATA_ERRORS,
    RecordingError,
    UnreadableError,
    active_path,
    may_hold,
)
from fantwin.pipeline.recordings.run_recordings import RECORDING_KEY
from fantwin.pipeline.recordings.writing import RecordingWriter
from fantwin.schemas.envelope import Envelope
from fantwin.schemas.topics import BY_NAME, HEALTH
from fantwin.schemas.units import NS_PER_S

LEAD_S = 200.0
"""snapshots of large trays are three minutes apart at 100 Hz"""
PARTS_SEARCHED = 3
"""before the part where a clip begins, for the snapshot and the twin"""
ROOM_BYTES = 4 << 20
"""that must be free beyond `least_free_bytes` for a clip to be cut"""
REST_S = 0.002
"""after each chunk, for the thread that records"""
_JUDGED = ("alarm", "overview", "snapshot")
"""topics that a clip has, as samples that were made of others, from its snapshot on"""
_OF_A_TRAY = ("fans", "speed_unit", NAMES_KEY, TACHO_KEY, "twin_sha256")
_OF_A_PART = ("part", "continues", "session", "paused_t_ns", "resumed_t_ns", "paused_because", "lost_in_pause")


@dataclass(frozen=True)
class ClipCutter:
    """Writes clips of one recording.

    Attributes:
        recording: its first part.
        free_bytes: of its disk; raises DiskError.
        least_free_bytes: that stay free; half of them may be used while a clip is written, until the oldest part is
            deleted.
        margin_s: of raw samples before all else.
    """

    recording: Path
    free_bytes: Callable[[], int]
    least_free_bytes: Callable[[], int] = lambda: 0
    margin_s: float = CLOCK_MARGIN_S

    def cut(self, clip: Clip) -> CutResult:
        """Write a clip, and say what came of it."""
        path = clip_folder(self.recording) / clip.name
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._require(self.least_free_bytes() + ROOM_BYTES)
            lacks = self._write(clip, path)
            return CutResult(clip.name, path.stat().st_size, lacks)
        except RecordingError as error:
            may_pass = isinstance(error, DiskError | UnreadableError)
            failed = CutResult(clip.name, problem=str(error), may_pass=may_pass)
        except OSError as error:
            why = refused(f"{path.parent}: cannot be written", error, "make room, or correct the folder")
            failed = CutResult(clip.name, problem=str(why), may_pass=True)
        for left in (path, active_path(path)):  # as far as the disk has taken it
            with suppress(OSError):
                left.unlink(missing_ok=True)
        return failed

    def _write(self, clip: Clip, path: Path) -> str:
        """Write a clip to a file. Returns what it lacks. Raises RecordingError, OSError."""
        margin_ns, lead_ns = round(self.margin_s * NS_PER_S), round(LEAD_S * NS_PER_S)
        parts = _parts_since(self.recording, clip.tray, clip.judged_since_ns - lead_ns - margin_ns)
        snapshot = _last_before(parts, "snapshot", clip.judged_since_ns)
        from_ns = max(snapshot.received_t_ns, clip.judged_since_ns - lead_ns) if snapshot else clip.judged_since_ns
        start_ns = from_ns - margin_ns
        within = [part for part in parts if part.first_ns <= clip.until_ns and part.last_ns >= start_ns]
        if not within:
            raise RecordingError("nothing of that time is recorded any more")
        of_part = read_metadata(within[0].file)
        metadata, attachments = _about(of_part, clip, start_ns)
        judged_after_ns = snapshot.newest_t_ns if snapshot else None
        if judged_after_ns is not None:
            metadata[CLIP_SNAPSHOT_KEY] = str(judged_after_ns)
        twin = _last_before(parts, "twin", start_ns)
        is_oldest = within[0] is parts[0] and "continues" in of_part.metadata
        is_cut_off = is_oldest and within[0].first_ns > start_ns
        lacks, topics = "parts that it needs were deleted to make room" if is_cut_off else "", set[str]()
        with RecordingWriter(path, metadata, attachments, t_ns=start_ns, overwrite=True) as writer:
            for each in filter(None, (twin, snapshot)):
                writer.add(each.received_at(start_ns))
            for part, chunk in ((each, chunk) for each in within for chunk in each.chunks):
                if chunk.message_end_time < start_ns or chunk.message_start_time > clip.until_ns:
                    continue
                try:
                    envelopes = part.envelopes(chunk)
                except OSError:
                    lacks = "a part was deleted meanwhile"
                    continue
                except CORRUPT_DATA_ERRORS:
                    lacks = "a chunk is damaged"
                    continue
                for envelope in envelopes:
                    if _is_wanted(envelope, clip, start_ns, judged_after_ns):
                        writer.add(envelope)
                        topics.add(envelope.topic)
                time.sleep(REST_S)
                self._require(self.least_free_bytes() // 2)
            if not topics:
                raise RecordingError("nothing of that time is recorded any more")
        return lacks or ("" if "raw" in topics else "it has no raw samples")

    def _require(self, least_bytes: int) -> None:
        free = self.free_bytes()
        if free < least_bytes:
            raise DiskError(f"{free / 1e6:,.1f} MB are free on the disk, and {least_bytes / 1e6:,.1f} MB are required")


def _parts_since(recording: Path, tray: str, t_ns: int) -> list[IndexedRecording]:
    """The parts with a message from this time on, and PARTS_SEARCHED before them, the oldest first; of a tray.

    Where the host's clock was set back after a part, it is the last: all before it have later times, and may be
    thousands.
    """
    found: list[IndexedRecording] = []
    before = 0
    for part in _parts_backwards(recording, tray):
        was_set_back = bool(found) and part.first_ns > found[-1].first_ns + SET_BACK_NS
        found.append(part)
        before += part.last_ns < t_ns
        if was_set_back or before > PARTS_SEARCHED:
            break
    return found[::-1]


def _parts_backwards(recording: Path, tray: str) -> Iterator[IndexedRecording]:
    """The parts of a recording, the newest first; those that cannot be read are left out."""
    for _, path in sorted(part_files(recording), reverse=True):
        with suppress(OSError, RecordingError):
            if read_metadata(path).metadata.get(RECORDING_KEY) == recording.name:
                part = IndexedRecording(path, tray=tray)
                if part.chunks:
                    yield part


def _last_before(parts: Sequence[IndexedRecording], topic: str, t_ns: int) -> Envelope | None:
    """The last message of a topic that was received up to this time."""
    for part in reversed(parts):
        numbers = {number for number, (_, name) in part.channels.items() if name == topic}
        for chunk in reversed(part.chunks):
            if chunk.message_start_time > t_ns or not may_hold(chunk, numbers):
                continue
            with suppress(OSError, *CORRUPT_DATA_ERRORS):
                found = [each for each in part.envelopes(chunk) if each.topic == topic and each.received_t_ns <= t_ns]
                if found:
                    return found[-1]
    return None


def _is_wanted(envelope: Envelope, clip: Clip, start_ns: int, judged_after_ns: int | None) -> bool:
    if not start_ns <= envelope.received_t_ns <= clip.until_ns:
        return False
    if envelope.topic == HEALTH:
        return envelope.received_t_ns >= clip.since_ns
    is_judged = envelope.topic in _JUDGED or (BY_NAME[envelope.topic].has_samples and envelope.topic != "raw")
    return not is_judged or judged_after_ns is None or envelope.newest_t_ns > judged_after_ns


def _about(of_part: RecordingMetadata, clip: Clip, start_ns: int) -> tuple[dict[str, str], dict[str, bytes]]:
    """Metadata and attachments: those of the part, as far as they are about this tray."""
    others = [tray for tray in of_part.trays if tray != clip.tray]
    not_about_it = {f"{name}.{tray}" for name in _OF_A_TRAY for tray in others} | set(_OF_A_PART)
    metadata = {name: text for name, text in of_part.metadata.items() if name not in not_about_it} | {
        "trays": clip.tray,
        "started": datetime.fromtimestamp(start_ns / NS_PER_S, UTC).isoformat(timespec="milliseconds"),
        "started_t_ns": str(start_ns),
        RECORDING_KEY: clip.name,
        CLIP_KEY: json.dumps(clip.about()),
    }
    not_attached = {f"{tray}.onnx" for tray in others}
    attachments = {name: data for name, data in of_part.attachments.items() if name not in not_attached}
    return metadata, attachments
