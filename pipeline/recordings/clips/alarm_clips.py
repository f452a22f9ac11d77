"""The alarm clips of one recorder: what its core asks of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path

from fantwin.pipeline.recordings.clips.clip import NOT_A_LIST, Clip, clips_in, list_path
from fantwin.pipeline.recordings.clips.cutting import LEAD_NS
from fantwin.pipeline.recordings.clips.tracker import LONGEST_NS, RETRY_NS, ClipTracker
from fantwin.pipeline.recordings.clips.worker import ClipWorker
from fantwin.pipeline.recordings.indexed import PartIndex
from fantwin.pipeline.recordings.rare_messages import last_message_ns, rare_messages
from fantwin.pipeline.recordings.reading import RecordingError
from fantwin.schemas.envelope import Envelope
from fantwin.schemas.messages import Alarm


def tracker_of(recording: Path, before_s: float, after_s: float, most_bytes: int, settled_s: float) -> ClipTracker:
    """What follows the clips of a recording, which continues the list that is there. recording: its first part."""
    try:
        clips = clips_in(list_path(recording))
    except NOT_A_LIST:
        clips = []
    return ClipTracker(clips, before_s, after_s, most_bytes, settled_s)


CLOSE_S = 3.0
"""for clips that are cut when the recorder stops"""


class AlarmClips:
    """Follows the alarms, has clips cut when they are due, and says what may be deleted."""

    def __init__(self, tracker: ClipTracker, maker: ClipWorker) -> None:
        self._tracker, self._maker = tracker, maker
        self._saved, self._saved_ns = tracker.version, 0
        self._undeletable = ""

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
        self._tracker.add(alarm, envelope.received_t_ns)

    def tick(self, now_ns: int, open_part: Callable[[], PartIndex | None], unsaved_since_ns: int | None = None) -> None:
        """Take what was cut, delete what is too much, and have cut what is due. open_part: of the part that is being
        written, asked for only where something is due. unsaved_since_ns: see `ClipTracker.due`."""
        for result in self._maker.results():
            self._tracker.cut(result)
        self._undeletable = ""
        try:
            while clip := self._tracker.to_delete():
                self._delete(clip)
        except RecordingError as error:
            self._undeletable = str(error)
        if self._maker.problem() and abs(now_ns - self._saved_ns) >= RETRY_NS:
            self._saved = -1  # the disk has refused it
        self._save(now_ns)  # before it is cut: a clip that is due survives a crash
        if due := self._tracker.due(now_ns, unsaved_since_ns):
            self._maker.cut(due, open_part())

    def oldest_acknowledged_until_ns(self) -> int | None:
        """The end of the first clip that may be deleted; None: there is none."""
        clip = self._tracker.oldest_acknowledged
        return clip.until_ns if clip else None

    def unacknowledged_before(self, t_ns: float) -> list[Clip]:
        """The clips from before this time that have unacknowledged alarms."""
        return [clip for clip in self._tracker.clips if clip.until_ns < t_ns and not clip.is_acknowledged]

    def delete_oldest_acknowledged(self) -> str | None:
        """Delete the first clip that may be deleted, and give its name; None if there is none.

        Raises:
            RecordingError: it cannot be deleted.
        """
        clip = self._tracker.oldest_acknowledged
        if clip is None:
            return None
        self._delete(clip)
        return clip.name

    def needs(self, last_ns: int) -> bool:
        """Whether a clip that is still to be cut needs what was received up to this time."""
        since_ns = self._tracker.needed_since_ns
        return since_ns is not None and since_ns - LEAD_NS <= last_ns

    @property
    def is_running(self) -> bool:
        """Whether a clip is still to be cut."""
        return self._tracker.needed_since_ns is not None

    def part_deleted(self) -> None:
        """A part that due clips need was deleted, because the disk was full."""
        self._tracker.part_deleted()

    def close(self, open_part: Callable[[], PartIndex | None]) -> None:
        """The recorder stops: cut what is due as far as it goes. After a restart it is cut again, with what follows."""
        if unfinished := self._tracker.unfinished():
            self._maker.cut(unfinished, open_part())
        self._maker.end(CLOSE_S)
        for result in self._maker.results():
            self._tracker.cut(result)
        self._save(self._saved_ns)

    def counters(self) -> Mapping[str, int]:
        """Clips that were cut, that could not be kept, and that were deleted."""
        return self._tracker.counts

    def problem(self) -> str:
        """Why clips cannot be cut, kept or deleted; empty if all is well."""
        return self._undeletable or self._tracker.problem() or self._maker.problem()

    def _delete(self, clip: Clip) -> None:
        self._maker.delete(clip)
        self._tracker.deleted(clip)  # only now: what is still there takes room, and must not be forgotten

    def _save(self, now_ns: int) -> None:
        if self._tracker.version != self._saved:
            self._saved, self._saved_ns = self._tracker.version, now_ns
            self._maker.save(self._tracker.clips)
