"""Cutting alarm clips in a thread of its own, so that recording never waits for it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from queue import SimpleQueue

from fantwin.pipeline.files import replace_file
from fantwin.pipeline.recordings.clips.clip import Clip, clip_folder, clips_as_text, list_path
from fantwin.pipeline.recordings.clips.cutting import cut_clips, remove_unfinished
from fantwin.pipeline.recordings.clips.tracker import CutResult
from fantwin.pipeline.recordings.disk import DiskError, refused
from fantwin.pipeline.recordings.indexed import PartIndex
from fantwin.pipeline.recordings.records import RecordingError

AT_ONCE = 16
"""clips that are written in one pass over the parts"""
ROOM_BYTES = 4 << 20
"""that must be free beyond recorder.min_free_bytes for clips to be cut"""
REST_S = 0.002
"""after each chunk, for the thread that records"""


class ClipWorker:
    """Cuts the clips of one recording."""

    def __init__(self, recording: Path, min_free_bytes: int, free_bytes: Callable[[], int]) -> None:
        """recording: its first part. free_bytes: of its disk; raises DiskError. min_free_bytes: half of it may be used
        while a clip is written, until the oldest part is deleted."""
        self._recording, self._folder, self._list = recording, clip_folder(recording), list_path(recording)
        self._begin_bytes = min_free_bytes + ROOM_BYTES
        self._least_bytes = min_free_bytes // 2
        self._free_bytes = free_bytes
        self._jobs: SimpleQueue[Callable[[], None] | None] = SimpleQueue()
        self._results: SimpleQueue[CutResult] = SimpleQueue()
        self._to_save: Sequence[Clip] | None = None
        self._problem = ""
        self._thread: threading.Thread | None = None
        self._has_ended = False
        remove_unfinished(self._folder)

    def save(self, clips: Sequence[Clip]) -> None:
        """Write the list of clips; of lists that wait, only the newest. After `end` it is written at once: a clip that
        takes longer than there was time for may still be cut."""
        self._to_save = tuple(clips)
        if self._has_ended:
            self._do(self._save)
        else:
            self._put(self._save)

    def cut(self, clips: Sequence[Clip], open_part: PartIndex | None) -> None:
        """Cut clips; `results` says what came of it. open_part: of the part that is being written."""
        for first in range(0, len(clips), AT_ONCE):
            some = tuple(clips[first : first + AT_ONCE])
            self._put(lambda some=some: self._cut(some, open_part))

    def results(self) -> list[CutResult]:
        """What came of clips since the last call."""
        found: list[CutResult] = []
        while not self._results.empty():
            found.append(self._results.get())
        return found

    def delete(self, clip: Clip) -> None:
        """Delete the file of a clip, at once: what waits behind clips that are being cut makes no room, and more is
        deleted. Raises RecordingError if that is not possible."""
        path = self._folder / clip.name
        try:
            path.unlink(missing_ok=True)
        except OSError as error:
            advice = "other clips and recordings are kept until this file is gone: delete it or move it"
            raise refused(f"{path}: cannot be deleted", error, advice) from error

    def problem(self) -> str:
        """Why the list cannot be written; empty if it can."""
        return self._problem

    def end(self, timeout_s: float) -> None:
        """Finish what was asked for, as far as there is time, and stop."""
        self._has_ended = True
        if self._thread is not None:
            self._jobs.put(None)
            self._thread.join(timeout_s)
            self._thread = None

    def _put(self, job: Callable[[], None]) -> None:
        if self._thread is None:  # only once there is something to do: most recorders never have an alarm
            self._thread = threading.Thread(target=self._work, name="clips", daemon=True)
            self._thread.start()
        self._jobs.put(job)

    def _work(self) -> None:
        while (job := self._jobs.get()) is not None:
            self._do(job)

    def _do(self, job: Callable[[], None]) -> None:
        try:
            job()
        except OSError as error:
            self._problem = f"{self._folder}: cannot be written: {error.strerror}; make room, or correct the folder"

    def _save(self) -> None:
        clips, self._to_save = self._to_save, None
        if clips is None:
            return
        replace_file(self._list, clips_as_text(clips).encode())
        self._problem = ""

    def _cut(self, clips: Sequence[Clip], open_part: PartIndex | None) -> None:
        try:
            self._require(self._begin_bytes)
            found = cut_clips(clips, self._recording, self._folder, open_part, self._rest)
        except (RecordingError, OSError) as error:
            found = [CutResult(clip.name, problem=str(error), may_pass=True) for clip in clips]
        except Exception as error:  # noqa: BLE001  a recorder goes on recording whatever is wrong with a clip
            found = [CutResult(clip.name, problem=f"{type(error).__name__}: {error}") for clip in clips]
        for result in found:
            self._results.put(result)

    def _rest(self) -> None:
        time.sleep(REST_S)
        self._require(self._least_bytes)

    def _require(self, least_bytes: int) -> None:
        free = self._free_bytes()
        if free < least_bytes:
            raise DiskError(f"{free / 1e6:,.1f} MB are free on the disk, and {least_bytes / 1e6:,.1f} MB are required")
