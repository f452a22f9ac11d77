"""The core of the recorder: adds every message to the open part, begins new parts, and waits while the disk refuses."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress

from fantwin.pipeline.recordings.clips.alarm_clips import AlarmClips
from fantwin.pipeline.recordings.disk import DiskError
from fantwin.pipeline.recordings.disk_room import DiskRoom
from fantwin.pipeline.recordings.interference import Interference
from fantwin.pipeline.recordings.parts import RecordingParts
from fantwin.pipeline.recordings.reading import RecordingError
from fantwin.pipeline.recordings.recorded_healths import RecordedHealths
from fantwin.pipeline.recordings.recorder_config import FLUSH_BYTES, FLUSH_S, LONGEST_FLUSH_S, RecorderConfig
from fantwin.pipeline.recordings.sequence_ledger import SequenceLedger
from fantwin.pipeline.recordings.writing import RecordingWriter
from fantwin.pipeline.runtime.stage import Core
from fantwin.schemas.envelope import Envelope
from fantwin.schemas.health import Health
from fantwin.schemas.messages import Message
from fantwin.schemas.topics import HEALTH
from fantwin.schemas.units import NS_PER_S

HELD_BYTES = 16 << 20
"""the most bytes of messages kept in memory while nothing can be recorded"""
TICK_NS = 50_000_000
"""about the time between ticks"""
DISK_CHECK_NS = NS_PER_S
"""time between two checks of the free space"""
LIMITS_CHECK_NS = 10 * NS_PER_S
"""time between two checks of the limits on age and size; they are also checked before each part"""
URGENT = ("alarm", "request", "twin")
"""topics whose messages are on the disk within FLUSH_S"""
ROOM_TO_RESUME = 1 << 20
"""bytes that must be free beyond the minimum to resume, so that recording does not pause again at once"""


class Recorder(Core):
    """Adds every message to the open part, and begins new parts.

    While the disk refuses, messages are kept in memory up to HELD_BYTES and the health reports a problem; about once a
    second the recorder tries to resume.
    """

    def __init__(
        self,
        parts: RecordingParts,
        config: RecorderConfig,
        now_ns: int,
        clips: AlarmClips,
        left_out: Collection[str] = (),
    ) -> None:
        """Begin the first part, at `now_ns`. If the disk is full or gone, wait for it. left_out: topics that are left
        out on purpose.

        Raises:
            RecordingError: nothing can be recorded there.
        """
        self._parts = parts
        self._clips = clips
        self._room = DiskRoom(parts, config)
        self._part: RecordingWriter | None = None
        self._least_bytes = 0
        """size below which a part does not end: its attachments alone may be more than its limit"""
        self._ledger = SequenceLedger(parts.before, left_out)
        self._before = parts.before
        self._cards: dict[str, Envelope] = {}
        self._recorded: Counter[str] = Counter()
        self._counts: Counter[str] = Counter(lost_unwritten=0)
        self._held: deque[Envelope] = deque()
        """messages that wait while the disk refuses them"""
        self._held_bytes = 0
        self._interference = Interference()
        self._healths = RecordedHealths()
        self._lost_in_pause = 0
        self._problem = self._paused_because = ""
        self._now_ns = self._paused_ns = self._began_ns = self._checked_ns = now_ns
        self._limited_ns = now_ns - LIMITS_CHECK_NS
        self._flushed_ns = 0
        self._unflushed_ns: int | None = None
        """time of receipt of the oldest message that may not be on the disk yet"""
        self._unflushed_bytes = 0
        self._is_urgent = False
        """true if a message must be on the disk soon"""
        try:
            self._keep_limits()
            shortage = self._room.shortage(0)
            if not shortage:
                self._begin({})
        except DiskError as error:
            shortage = str(error)
        if shortage:
            self._pause(shortage)

    def step(self, item: Envelope) -> Sequence[Message]:
        """Record one message."""
        self._now_ns = max(self._now_ns, item.received_t_ns)
        if item.topic == "twin":
            self._cards[item.key] = item
        elif self._before and self._was_recorded(item):
            self._ledger.add_duplicated(item.key, item.header.producer)
            return ()
        if item.topic == HEALTH and isinstance(item.message, Health):
            if not self._healths.is_due(item, item.message):
                return ()
            self._is_urgent |= bool(item.message.problem)
        elif item.topic in URGENT:
            self._is_urgent = True
        if item.topic == "alarm":
            self._clips.add(item)  # first: the list of clips is on the disk before the alarm is
        self._record(item)
        return ()

    def tick(self, now_ns: int) -> Sequence[Message]:
        """Flush, begin a new part and check the disk when each is due."""
        if now_ns < self._now_ns - DISK_CHECK_NS:  # the host's clock was set back: restart all intervals
            self._checked_ns = self._began_ns = self._limited_ns = now_ns
            self._paused_ns = min(self._paused_ns, now_ns)
            self._interference.clock_set_back(now_ns)
            self._flushed_ns = now_ns - round(LONGEST_FLUSH_S * NS_PER_S)
            self._unflushed_ns = None if self._unflushed_ns is None else self._flushed_ns  # due at once
        self._now_ns = now_ns
        if self._part and self._is_flush_due():
            self._flush()
        if now_ns - self._checked_ns >= DISK_CHECK_NS:
            self._checked_ns = now_ns
            if self._part:
                self._check_disk()
            else:
                self._resume()
        if now_ns - self._limited_ns >= LIMITS_CHECK_NS:
            self._keep_limits()
        if self._part and self._is_full(self._part):
            self._attempt(self._end_part)
            self._keep_limits(has_ended_part=True)
            if not self._problem:
                self._attempt(lambda: self._begin({}))
        self._clips.tick(now_ns, self._flush)
        return ()

    def close(self) -> Sequence[Message]:
        """Finish the file; messages that could not be written are lost now."""
        self._attempt(lambda: self._end_part(has_ended=True))
        if self._held:
            self._resume()
            self._attempt(lambda: self._end_part(has_ended=True))
        self._counts["lost_unwritten"] += len(self._take_held())
        self._clips.close()
        return ()

    def abort(self) -> None:
        """Finish the file after a crash; it does not say that the recorder ended in order. A recorder that has received
        nothing, such as one that is refused at its start, leaves no file."""
        if self._part and not (self._recorded or self._part.written or self._part.pending):
            with suppress(OSError):
                self._part.discard()
            self._part = None
        self._attempt(self._end_part)

    def counters(self) -> Mapping[str, int]:
        """Messages of each topic that are on the disk, messages lost because they could not be written or because their
        file was deleted, parts, and files that were restored."""
        recorded = self._recorded + (self._part.written if self._part else Counter())
        written = {f"recorded_{topic}": count for topic, count in recorded.items()}
        of_clips = self._clips.tracker.counts
        return {**written, **self._counts, **self._room.counts, **self._interference.counts, **of_clips}

    def notes(self) -> Sequence[str]:
        """The space and days that recordings take of their limits, and the topics that are left out on purpose."""
        left_out = ", ".join(self._ledger.left_out)
        of_topics = [f"not recorded: {left_out} (recorder.topics)"] if left_out else []
        return [*self._room.notes(), *self._clips.notes(), *of_topics]

    def unsaved(self) -> Sequence[Envelope]:
        """Messages that are not flushed to the disk yet."""
        return self._part.pending if self._part else tuple(self._held)

    def problem(self) -> str:
        """Why nothing is recorded now, what another program did to the file, and why limits are not kept; empty if all
        is well."""
        others = self._interference.problem(self._now_ns), self._room.problem, self._clips.problem()
        return self._problem or "; ".join(filter(None, others))

    def _was_recorded(self, item: Envelope) -> bool:
        """Whether a recorder before this one has recorded the message."""
        return item.header.sequence < self._before.get((item.key, item.header.producer), 0)

    def _flush(self) -> bool:
        """Bring all messages to the disk; False if it refuses."""
        if self._part:
            self._unflushed_ns, self._flushed_ns = None, self._now_ns
            self._unflushed_bytes, self._is_urgent = 0, False
            self._attempt(self._part.flush)
        return not self.unsaved()

    def _record(self, envelope: Envelope) -> None:
        if self._part is None:
            self._hold([envelope])
            return
        if self._unflushed_ns is None:
            self._unflushed_ns = min(envelope.received_t_ns, self._now_ns)
        self._unflushed_bytes += len(envelope.payload)
        try:
            self._part.add(envelope)
        except RecordingError as error:
            self._pause(str(error))

    def _attempt(self, action: Callable[[], None]) -> None:
        """Do something that the disk may refuse, and pause if it does."""
        try:
            action()
        except RecordingError as error:
            self._pause(str(error))

    def _begin(self, about: Mapping[str, str]) -> None:
        self._began_ns = min(self._held[0].received_t_ns, self._now_ns) if self._held else self._now_ns
        self._part = self._parts.begin(self._began_ns, self._ledger, about)
        self._part.before_chunk = self._clips.save
        self._least_bytes = 2 * self._part.size
        self._counts["parts"] += 1
        self._problem = ""
        for card in self._cards.values():
            self._part.add(card.received_at(self._began_ns))

    def _is_flush_due(self) -> bool:
        """Return whether a message would be unflushed for too long at the next tick; behind a backlog, where each has
        waited for long, once in FLUSH_S."""
        is_soon = self._is_urgent or self._unflushed_bytes >= FLUSH_BYTES
        flush_ns = (FLUSH_S if is_soon else LONGEST_FLUSH_S) * NS_PER_S
        return (
            self._unflushed_ns is not None
            and self._now_ns - self._unflushed_ns >= flush_ns - TICK_NS
            and self._now_ns - self._flushed_ns >= FLUSH_S * NS_PER_S - TICK_NS
        )

    def _is_full(self, part: RecordingWriter) -> bool:
        is_large = part.size >= max(self._room.part_bytes, self._least_bytes)
        return is_large or self._now_ns - self._began_ns >= self._room.part_s * NS_PER_S

    def _keep_limits(self, *, has_ended_part: bool = False) -> None:
        self._limited_ns = self._now_ns
        self._room.keep_limits(self._now_ns, has_ended_part=has_ended_part)

    def _end_part(self, *, has_ended: bool = False) -> None:
        """Finish the open part. It is closed even if this raises RecordingError."""
        if self._part is None:
            return
        try:
            for health in self._healths.take_waiting():
                self._part.add(health)
            self._part.finish(has_ended=has_ended)
        finally:
            self._release_part()

    def _release_part(self) -> None:
        if self._part:
            self._interference.check(self._part, self._now_ns)
            self._recorded += self._part.written
            self._lost_in_pause += self._part.lost
            self._ledger = self._ledger.as_lost() if self._part.lost else self._ledger.for_next_part()
            unwritten, self._part, self._unflushed_ns = self._part.pending, None, None
            self._unflushed_bytes, self._is_urgent = 0, False
            self._hold(unwritten)

    def _hold(self, unwritten: Sequence[Envelope]) -> None:
        """Keep messages in memory until they can be recorded; beyond HELD_BYTES the oldest are lost."""
        self._held.extend(unwritten)
        self._held_bytes += sum(len(envelope.payload) for envelope in unwritten)
        while self._held_bytes > HELD_BYTES:
            lost = self._held.popleft()
            self._held_bytes -= len(lost.payload)
            self._ledger.add_lost(lost.key, lost.message.header.producer, lost.message.header.sequence)
            self._counts["lost_unwritten"] += 1
            self._lost_in_pause += 1

    def _take_held(self) -> list[Envelope]:
        held = list(self._held)
        self._held.clear()
        self._held_bytes = 0
        return held

    def _check_disk(self) -> None:
        try:
            shortage = self._room.shortage(0)
        except RecordingError as error:
            shortage = str(error)
        if shortage:
            with suppress(RecordingError):  # the reason is known already
                self._end_part()
            self._pause(shortage)
        elif self._part:
            self._attempt(self._part.stay_in_place)
        if self._part:
            self._interference.check(self._part, self._now_ns)

    def _pause(self, reason: str) -> None:
        self._release_part()
        if not self._problem:
            self._paused_ns, self._paused_because = self._now_ns, reason
            self._counts["pauses"] += 1
        self._problem = f"NOTHING IS RECORDED: {reason}; recording resumes automatically when this is resolved"

    def _resume(self) -> None:
        about = {
            "paused_t_ns": str(self._paused_ns),
            "resumed_t_ns": str(self._now_ns),
            "paused_because": self._paused_because,
            "lost_in_pause": str(self._lost_in_pause),
        }
        try:
            shortage = self._room.shortage(ROOM_TO_RESUME + self._held_bytes)
            if not shortage:
                self._begin(about)
        except RecordingError as error:
            shortage = str(error)
        if shortage:
            self._pause(shortage)
            return
        self._lost_in_pause = 0
        self._limited_ns = self._now_ns - LIMITS_CHECK_NS  # due now: the disk may be another
        for envelope in self._take_held():
            self._record(envelope)
