"""The alarm clips of one recorder: what its core asks of them. They are cut in a thread, so that recording never waits
for it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from queue import SimpleQueue

from fantwin.pipeline.files import replace_file
from fantwin.pipeline.recordings.clips.clip import NOT_A_LIST, Clip, clip_folder, clips_as_text, clips_in, list_path
from fantwin.pipeline.recordings.clips.cutting import LEAD_NS, remove_unfinished
from fantwin.pipeline.recordings.clips.tracker import LONGEST_NS, RETRY_NS, ClipTracker, CutResult
from fantwin.pipeline.recordings.disk import refused
from fantwin.pipeline.recordings.indexed import PartIndex, last_message_ns, rare_messages
from fantwin.pipeline.recordings.reading import RecordingError
from fantwin.schemas.envelope import Envelope
from fantwin.schemas.messages import Alarm
from fantwin.schemas.units import NS_PER_S

SAVE_NS = NS_PER_S
"""between two times that the list is written: a flood of alarms changes it at every tick"""
CLOSE_S = 3.0
"""for clips that are cut when the recorder stops"""


def listed_clips(recording: Path) -> list[Clip]:
    """The clips of a recording that are known from before; none where there is no list. recording: its first part."""
    try:
        return clips_in(list_path(recording))
    except NOT_A_LIST:
        return []


class AlarmClips:
    """Follows the alarms, has clips cut when they are due, and says what may be deleted."""

    def __init__(
        self, tracker: ClipTracker, recording: Path, cut: Callable[[Clip, PartIndex | None], CutResult]
    ) -> None:
        """recording: its first part. cut: writes a clip, in a thread (`ClipCutter.cut`)."""
        self.tracker, self._cut = tracker, cut
        self._folder, self._list = clip_folder(recording), list_path(recording)
        self._thread: threading.Thread | None = None
        self._results: SimpleQueue[CutResult] = SimpleQueue()
        self._saved, self._saved_ns = tracker.version, 0
        self._unwritten = self._undeletable = ""
        remove_unfinished(self._folder)

    def continue_after(self, last_part: Path) -> None:
        """Follow the last alarms that a recorder before this one has recorded: it may have been killed before it had
        written down that clips are due."""
        since_ns = last_message_ns(last_part) - LONGEST_NS
        with suppress(RecordingError):
            for envelope in rare_messages(last_part, "alarm"):
                if envelope.received_t_ns >= since_ns:
                    self.add(envelope)

    def add(self, envelope: Envelope) -> None:
        """Follow a message of topic alarm."""
        alarm = envelope.message
        assert isinstance(alarm, Alarm)
        self.tracker.add(alarm, envelope.received_t_ns)

    def tick(self, now_ns: int, open_part: Callable[[], PartIndex | None], unsaved_since_ns: int | None = None) -> None:
        """Take what was cut, delete what is too much, and have cut what is due. open_part: of the part that is being
        written, asked for only where something is due. unsaved_since_ns: see `ClipTracker.due`."""
        self.tracker.follow(now_ns)  # also while clips are cut
        self._take_results()
        self._undeletable = ""
        try:
            while clip := self.tracker.to_delete():
                self.delete(clip)
        except RecordingError as error:
            self._undeletable = str(error)
        if abs(now_ns - self._saved_ns) >= (RETRY_NS if self._unwritten else SAVE_NS):
            self._save(now_ns)
        is_cutting = self._thread is not None and self._thread.is_alive()
        if not is_cutting and (due := self.tracker.due(now_ns, unsaved_since_ns)):
            self._begin(due, open_part())

    def delete(self, clip: Clip) -> None:
        """Delete a clip, which then is no longer known. Raises RecordingError if that is not possible."""
        path = self._folder / clip.name
        try:
            path.unlink(missing_ok=True)
        except OSError as error:
            advice = "other clips and recordings are kept until this file is gone: delete it or move it"
            raise refused(f"{path}: cannot be deleted", error, advice) from error
        self.tracker.deleted(clip)  # only now: what is still there takes room, and must not be forgotten

    def needs(self, last_ns: int) -> bool:
        """Whether a clip that is still to be cut needs what was received up to this time."""
        since_ns = self.tracker.needed_since_ns
        return since_ns is not None and since_ns - LEAD_NS <= last_ns

    def close(self, open_part: Callable[[], PartIndex | None]) -> None:
        """The recorder stops: cut what is due as far as it goes, while there is time. After a restart it is cut again,
        with what follows."""
        until_s = time.monotonic() + CLOSE_S
        self._join(until_s)
        if not self._thread and (unfinished := self.tracker.unfinished()):
            self._begin(unfinished, open_part())
            self._join(until_s)
        self._take_results()
        self._save(self._saved_ns)

    def problem(self) -> str:
        """Why clips cannot be cut, kept or deleted; empty if all is well."""
        return self._undeletable or self.tracker.problem() or self._unwritten

    def _begin(self, clips: Sequence[Clip], open_part: PartIndex | None) -> None:
        """Cut clips in a thread, which ends with the process: what it has not cut is cut after a restart."""
        self._thread = threading.Thread(target=self._work, args=(clips, open_part), name="clips", daemon=True)
        self._thread.start()

    def _work(self, clips: Sequence[Clip], open_part: PartIndex | None) -> None:
        for clip in clips:
            try:
                result = self._cut(clip, open_part)
            except Exception as error:  # noqa: BLE001  a recorder goes on recording whatever is wrong with a clip
                result = CutResult(clip.name, problem=f"{type(error).__name__}: {error}")
            self._results.put(result)

    def _join(self, until_s: float) -> None:
        """Wait for the clips that are being cut, while there is time."""
        if self._thread:
            self._thread.join(max(0.0, until_s - time.monotonic()))
            self._thread = self._thread if self._thread.is_alive() else None

    def _take_results(self) -> None:
        while not self._results.empty():
            self.tracker.cut(self._results.get())

    def _save(self, now_ns: int) -> None:
        if self.tracker.version == self._saved and not self._unwritten:
            return
        self._saved, self._saved_ns, self._unwritten = self.tracker.version, now_ns, ""
        try:
            replace_file(self._list, clips_as_text(self.tracker.clips).encode())
        except OSError as error:
            self._unwritten = f"{self._folder}: cannot be written: {error.strerror}; make room, or correct the folder"
