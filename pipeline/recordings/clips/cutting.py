"""Cutting alarm clips from the parts of a recording.

A clip has all that was recorded of its tray, and the health of all stages, from its beginning to its end. What comes
before makes it a recording that decides the same again: a snapshot of the scorer, the twin in force, what was made
since that snapshot, and the raw samples of CLOCK_MARGIN_S more, so that the device's clock and the twin's state are
settled when the scorer continues. Where snapshots are rare, at slow rates, the clip goes back LEAD_S at most.

A clip is written whole or not at all: under another name, flushed to the disk, then renamed.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from itertools import takewhile
from pathlib import Path

from fantwin.pipeline.files import sync_folder
from fantwin.pipeline.recordings.clips.clip import CLIP_KEY, CLIP_SNAPSHOT_KEY, Clip
from fantwin.pipeline.recordings.clips.part_chunks import PartChunks, parts_backwards
from fantwin.pipeline.recordings.clips.tracker import SET_BACK_NS, CutResult
from fantwin.pipeline.recordings.disk import DiskError, is_being_written, refused
from fantwin.pipeline.recordings.indexed import PartIndex
from fantwin.pipeline.recordings.reading import TACHO_KEY, RecordingMetadata
from fantwin.pipeline.recordings.records import CORRUPT_DATA_ERRORS, RecordingError, active_path, may_hold
from fantwin.pipeline.recordings.run_recordings import RECORDING_KEY
from fantwin.pipeline.recordings.writing import RecordingWriter
from fantwin.schemas.envelope import Envelope
from fantwin.schemas.topics import BY_NAME, HEALTH, tray_key
from fantwin.schemas.units import NS_PER_S

CLOCK_MARGIN_S = 90.0
"""the sliding window of the device clock, and time to approach its line (pipeline.recordings.excerpts)"""
LEAD_S = 200.0
"""snapshots of large trays are three minutes apart at 100 Hz"""
LEAD_NS = round((CLOCK_MARGIN_S + LEAD_S) * NS_PER_S)
"""a clip needs the recording from so long before its beginning, at most"""
PARTS_SEARCHED = 3
"""before the part where a clip begins, for the snapshot and the twin"""
UNFINISHED = ".unfinished-"
"""begins the name of a clip that is being written"""
_JUDGED = ("alarm", "snapshot")
"""topics that a clip has, as samples that were made of others, from its snapshot on"""
_OF_A_TRAY = ("fans", "speed_unit", TACHO_KEY, "twin_sha256")
_OF_A_PART = ("part", "continues", "session", "paused_t_ns", "resumed_t_ns", "paused_because", "lost_in_pause")


def cut_clips(
    clips: Sequence[Clip],
    recording: Path,
    folder: Path,
    open_part: PartIndex | None = None,
    rest: Callable[[], object] = lambda: None,
    margin_s: float = CLOCK_MARGIN_S,
) -> list[CutResult]:
    """Write clips to a folder, and say what came of each; all in one pass over the parts.

    recording: its first part. open_part: of the part that is being written, what is flushed. rest: is called now and
    then, so that others have their turn; where it raises RecordingError, because there is no more room, the last clip
    is given up. margin_s: of raw samples before all else.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        parts = _Parts(recording, open_part)
        cuts = [_Cut(clip, folder, parts, margin_s) for clip in clips]
        parts.go_back_to(min(cut.start_ns for cut in cuts))
    except OSError as error:
        why = refused(f"{recording}: the parts cannot be read", error, "see recorder.file")
        return [CutResult(clip.name, problem=str(why), may_pass=True) for clip in clips]
    for part in reversed(parts.read):
        for chunk in part.chunks:
            takers = [
                cut
                for cut in cuts
                if cut.start_ns <= chunk.message_end_time and chunk.message_start_time <= cut.clip.until_ns
            ]
            if not takers:
                continue
            try:
                envelopes = part.envelopes(chunk)
            except (OSError, *CORRUPT_DATA_ERRORS) as error:
                gone = "a part was deleted meanwhile" if isinstance(error, OSError) else "a chunk is damaged"
                for cut in takers:
                    cut.lacks = gone
                continue
            for cut in takers:
                cut.add(part, envelopes)
            try:
                rest()
            except RecordingError as error:
                begun = [cut for cut in cuts if cut.is_being_written]
                if not begun:
                    continue
                begun[-1].give_up(error)
    return [cut.finish() for cut in cuts]


def remove_unfinished(folder: Path) -> None:
    """Remove what a killed recorder has left of clips that it was writing. Others, of shards, may be writing now."""
    with suppress(OSError):
        for path in folder.glob(f"{UNFINISHED}*"):
            if not is_being_written(path):
                path.unlink()


class _Parts:
    """The parts of a recording, read from the newest one backwards as far as needed."""

    def __init__(self, recording: Path, open_part: PartIndex | None) -> None:
        self._unread = parts_backwards(recording, open_part)
        self.read: list[PartChunks] = []
        """the newest first"""

    def go_back_to(self, t_ns: int, more: int = 0) -> list[PartChunks]:
        """The parts with a message from this time on, and so many before them; the newest first."""
        before = sum(part.last_ns < t_ns for part in self.read)
        while before <= more and not self._is_at_set_back and (part := next(self._unread, None)):
            self.read.append(part)
            before += part.last_ns < t_ns
        needed = list(takewhile(lambda part: part.last_ns >= t_ns, self.read))
        return self.read[: len(needed) + more]

    @property
    def _is_at_set_back(self) -> bool:
        """Whether the host's clock was set back after the last one that was read: all before it have later times, and
        may be thousands."""
        return len(self.read) > 1 and self.read[-1].first_ns > self.read[-2].first_ns + SET_BACK_NS

    def last_before(self, key: str, t_ns: int) -> Envelope | None:
        """The last message of a key that was received up to this time."""
        for part in self.go_back_to(t_ns, PARTS_SEARCHED):
            numbers = part.channels_of(key)
            for chunk in reversed(part.chunks):
                if chunk.message_start_time > t_ns or not may_hold(chunk, numbers):
                    continue
                with suppress(OSError, *CORRUPT_DATA_ERRORS):
                    found = [each for each in part.envelopes(chunk) if each.key == key and each.received_t_ns <= t_ns]
                    if found:
                        return found[-1]
        return None


class _Cut:
    """One clip while it is written."""

    def __init__(self, clip: Clip, folder: Path, parts: _Parts, margin_s: float) -> None:
        self.clip = clip
        self.lacks = ""
        self._folder = folder
        self._path = folder / f"{UNFINISHED}{clip.name}"
        self._writer: RecordingWriter | None = None
        self._failed: RecordingError | None = None
        self._raws = 0
        site = next((part.site for part in parts.go_back_to(clip.judged_since_ns)), "")
        snapshot = parts.last_before(tray_key(site, clip.tray, "snapshot"), clip.judged_since_ns)
        lead_ns = clip.judged_since_ns - round(LEAD_S * NS_PER_S)
        from_ns = clip.judged_since_ns if snapshot is None else max(snapshot.received_t_ns, lead_ns)
        self.start_ns = from_ns - round(margin_s * NS_PER_S)
        self._judged_after_ns = snapshot.newest_t_ns if snapshot else None
        twin = parts.last_before(tray_key(site, clip.tray, "twin"), self.start_ns)
        self._first = [each.received_at(self.start_ns) for each in (twin, snapshot) if each]

    @property
    def is_being_written(self) -> bool:
        """Whether it takes room on the disk."""
        return self._writer is not None and self._failed is None

    def give_up(self, error: RecordingError) -> None:
        """Make room again."""
        self._failed = error
        self._remove()

    def add(self, part: PartChunks, envelopes: Sequence[Envelope]) -> None:
        """Add what belongs to the clip."""
        for envelope in envelopes if self._failed is None else ():
            if self._is_wanted(envelope):
                try:
                    writer = self._writer or self._begin(part.metadata)
                    writer.add(envelope)
                    self._raws += envelope.topic == "raw"
                except RecordingError as error:
                    self._failed = error
                    return

    def finish(self) -> CutResult:
        """Give the clip its name."""
        try:
            if self._writer is None and self._failed is None:
                return CutResult(self.clip.name, problem="nothing of that time is recorded any more")
            if self._failed is None and self._writer is not None:
                self._writer.finish()
                size = self._path.stat().st_size
                self._path.replace(self._folder / self.clip.name)
                sync_folder(self._folder)
                lacks = self.lacks or ("" if self._raws else "it has no raw samples")
                return CutResult(self.clip.name, size, lacks)
        except RecordingError as error:
            self._failed = error
        except OSError as error:
            self._failed = refused(f"{self._path}: cannot be written", error, "make room")
        self._remove()
        return CutResult(self.clip.name, problem=str(self._failed), may_pass=isinstance(self._failed, DiskError))

    def _remove(self) -> None:
        with suppress(OSError):
            if self._writer is not None:
                self._writer.discard()
        for path in (self._path, active_path(self._path)):
            with suppress(OSError):
                path.unlink(missing_ok=True)

    def _begin(self, of_part: RecordingMetadata) -> RecordingWriter:
        metadata, attachments = _about(of_part, self.clip, self.start_ns)
        if self._judged_after_ns is not None:
            metadata[CLIP_SNAPSHOT_KEY] = str(self._judged_after_ns)
        self._writer = RecordingWriter(self._path, metadata, attachments, t_ns=self.start_ns, overwrite=True)
        for envelope in self._first:
            self._writer.add(envelope)
        return self._writer

    def _is_wanted(self, envelope: Envelope) -> bool:
        if not self.start_ns <= envelope.received_t_ns <= self.clip.until_ns:
            return False
        if envelope.topic == HEALTH:
            return envelope.received_t_ns >= self.clip.since_ns
        if envelope.key.split("/")[2] != self.clip.tray:
            return False
        is_judged = envelope.topic in _JUDGED or (BY_NAME[envelope.topic].has_samples and envelope.topic != "raw")
        return not is_judged or self._judged_after_ns is None or envelope.newest_t_ns > self._judged_after_ns


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
