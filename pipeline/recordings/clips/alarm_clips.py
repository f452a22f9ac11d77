"""The alarm clips of one recorder: what its core asks of them. They are cut in a thread, so that recording never waits
for it."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from queue import SimpleQueue

from fantwin.pipeline.files import replace_file
from fantwin.pipeline.recordings.clips.clip import Clip, clip_folder, clips_as_text, list_path
from fantwin.pipeline.recordings.clips.tracker import ClipTracker, CutResult
from fantwin.pipeline.recordings.disk import refused
from fantwin.pipeline.recordings.disk_room import in_bytes
from fantwin.pipeline.recordings.reading import RecordingError
from fantwin.schemas.envelope import Envelope
from fantwin.schemas.messages import Alarm

CLOSE_S = 3.0
"""for clips that are being cut when the recorder stops"""


class AlarmClips:
    """Follows the alarms, has clips cut when they are due, and says what may be deleted."""

    def __init__(self, tracker: ClipTracker, recording: Path, cut: Callable[[Clip], CutResult]) -> None:
        """recording: its first part. cut: writes a clip, in a thread (`ClipCutter.cut`)."""
        self.tracker, self._cut = tracker, cut
        self._folder, self._list = clip_folder(recording), list_path(recording)
        self._thread: threading.Thread | None = None
        self._results: SimpleQueue[CutResult] = SimpleQueue()
        self._saved: list[Clip] | None = tracker.clips
        self._unwritten = self._undeletable = ""

    def add(self, envelope: Envelope) -> None:
        """Follow a message of topic alarm."""
        alarm = envelope.message
        assert isinstance(alarm, Alarm)
        self.tracker.add(alarm, envelope.received_t_ns)

    def tick(self, now_ns: int, flush: Callable[[], bool]) -> None:
        """Take what was cut, delete what is too much, and have cut what is due. flush: brings all that was received to
        the disk; returns False where the disk refuses."""
        self.tracker.follow(now_ns)  # also while clips are cut
        is_cutting = self._thread is not None and self._thread.is_alive()
        self._take_results()
        self._undeletable = ""
        try:
            while clip := self.tracker.to_delete:
                self._delete(clip)
        except RecordingError as error:
            self._undeletable = str(error)
        if not is_cutting and (due := self.tracker.due(now_ns)) and flush():
            # the thread ends with the process: what it has not cut is cut after a restart
            self._thread = threading.Thread(target=self._work, args=(due,), name="clips", daemon=True)
            self._thread.start()

    def save(self) -> None:
        """Write the list of clips if it has changed: before the alarms that they are of are on the disk."""
        if self.tracker.clips == self._saved:
            return
        clips = self.tracker.clips
        self._saved, self._unwritten = clips, ""
        try:
            replace_file(self._list, clips_as_text(clips))
        except OSError as error:
            self._saved = None
            self._unwritten = f"{self._folder}: cannot be written: {error.strerror}; make room, or correct the folder"

    def close(self) -> None:
        """The recorder stops: wait a moment for what is being cut. The next recorder cuts the rest."""
        if self._thread:
            self._thread.join(CLOSE_S)
        self._take_results()
        self.save()

    def notes(self) -> list[str]:
        """What is kept longer than recordings are, for people."""
        beyond = self.tracker.beyond
        size = in_bytes(sum(clip.size_bytes for clip in beyond))
        said = f"clips kept beyond recorder.keep_days until their alarms are acknowledged: {len(beyond)}, {size}"
        return [said] if beyond else []

    def problem(self) -> str:
        """Why clips cannot be cut, kept or deleted; empty if all is well."""
        return self._undeletable or self.tracker.problem() or self._unwritten

    def _delete(self, clip: Clip) -> None:
        """Delete a clip, which then is no longer known. Raises RecordingError if that is not possible."""
        path = self._folder / clip.name
        try:
            path.unlink(missing_ok=True)
        except OSError as error:
            advice = "other clips are kept until this file is gone: delete it or move it"
            raise refused(f"{path}: cannot be deleted", error, advice) from error
        self.tracker.deleted(clip)  # only now: what is still there takes room, and must not be forgotten

    def _work(self, clips: Sequence[Clip]) -> None:
        for clip in clips:
            try:
                result = self._cut(clip)
            except Exception as error:  # noqa: BLE001  a recorder goes on recording whatever is wrong with a clip
                result = CutResult(clip.name, problem=f"{type(error).__name__}: {error}")
            self._results.put(result)

    def _take_results(self) -> None:
        while not self._results.empty():
            self.tracker.cut(self._results.get())
            self.save()
