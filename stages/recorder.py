"""Recorder: keeps everything that goes over the bus in MCAP files.

Reads   every topic of the table that is to be recorded, of all trays, and the health of all stages
Writes  nothing on the bus; a recording in one part or several, docs/reference/recordings.md
Units   as in the messages: bytes are kept as they came
Timing  a message is safe from a crash, of the machine too, after `flush_interval_s` at most
"""

from __future__ import annotations

import logging
import os
import secrets
import shutil
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Protocol

from pydantic import Field, field_validator

from pipeline.recordings.disk import DiskError
from pipeline.recordings.metadata import head_of
from pipeline.recordings.parts import RecordingParts
from pipeline.recordings.reading import RecordingError
from pipeline.recordings.sequence_ledger import SequenceLedger, StreamId
from pipeline.runtime.stage import Context, Core, Parts, Stage, StageConfig, StageError
from schemas.envelope import Envelope
from schemas.messages import Health, Message
from schemas.topics import TOPICS

HELD_BYTES = 16 << 20
"""What is kept in memory at most while nothing can be recorded."""
TICK_NS = 50_000_000
"""After about this time comes the next tick."""
LOOK_NS = 1_000_000_000
"""How often the room on the disk is looked at."""
ROOM_TO_RESUME = 1 << 20
"""More than this must be free beyond the minimum, lest recording pauses again at once."""
_LOG = logging.getLogger(__name__)


class RecorderConfig(StageConfig):
    """Section `[recorder]`."""

    file: Path = Field(
        default=Path("recording.mcap"),
        description="relative to run_folder; its parts are NAME.mcap, NAME-2.mcap and so on",
    )
    flush_interval_s: float = Field(default=1.0, gt=0, description="at most this much is lost in a crash")
    part_bytes: int = Field(default=100_000_000, ge=0, description="a new part begins when one is this large; 0: never")
    part_s: float = Field(default=0.0, ge=0, description="a new part begins after this time; 0: never")
    min_free_bytes: int = Field(default=100_000_000, ge=0, description="this much room is left on the disk")
    delete_oldest: bool = Field(
        default=False, description="make room by deleting the oldest parts of this recording, instead of pausing"
    )

    @field_validator("part_bytes")
    @classmethod
    def _worth_a_part(cls, value: int) -> int:
        if 0 < value < 1_000_000:
            raise ValueError("a part is 1,000,000 bytes at least, or 0 for no limit")
        return value

    @field_validator("part_s")
    @classmethod
    def _longer_than_a_flush(cls, value: float) -> float:
        if 0 < value < 1.0:
            raise ValueError("a part is 1 s at least, or 0 for no limit")
        return value


class OpenPart(Protocol):
    """What the core needs of a part; see `pipeline.recordings.writing.RecordingWriter`."""

    path: Path
    written: Counter[str]

    @property
    def pending(self) -> Sequence[Envelope]: ...  # noqa: D102
    @property
    def size(self) -> int: ...  # noqa: D102
    def add(self, envelope: Envelope) -> None: ...  # noqa: D102
    def flush(self) -> None: ...  # noqa: D102
    def close(self, *, has_ended: bool = False) -> None: ...  # noqa: D102


class PartsPlace(Protocol):
    """Where parts begin; see `pipeline.recordings.parts.RecordingParts`."""

    @property
    def before(self) -> Mapping[StreamId, int]: ...  # noqa: D102
    def begin(self, t_ns: int, ledger: SequenceLedger, about: Mapping[str, str]) -> OpenPart: ...  # noqa: D102
    def free_bytes(self) -> int: ...  # noqa: D102
    def delete_oldest(self) -> str | None: ...  # noqa: D102


class Recorder(Core):
    """Hands every packet to the part that is open, and begins new ones.

    While nothing can be recorded it keeps what comes, as far as memory allows, and says so; about once a second it
    looks whether that has passed.
    """

    def __init__(self, place: PartsPlace, config: RecorderConfig, now_ns: int) -> None:
        """Begin the first part, at `now_ns`. A disk that is full or has gone is waited for.

        Raises:
            RecordingError: nothing can be recorded there.
        """
        self._place = place
        self._config = config
        self._part: OpenPart | None = None
        self._ledger = SequenceLedger(place.before)
        self._before = place.before
        self._cards: dict[str, Envelope] = {}
        self._own_producer = ""
        self._duplicated: dict[StreamId, int] = {}
        self._recorded: Counter[str] = Counter()
        self._counts: Counter[str] = Counter(lost_unwritten=0)
        self._held: deque[Envelope] = deque()
        self._held_bytes = 0
        self._lost_in_pause = 0
        self._problem = self._paused_because = ""
        self._now_ns = self._paused_ns = self._began_ns = self._looked_ns = now_ns
        self._flushed_ns = 0
        self._unflushed_ns: int | None = None
        """when the oldest message was received that may not be on the disk yet"""
        try:
            shortage = self._shortage(0)
            if not shortage:
                self._begin({})
        except DiskError as error:
            shortage = str(error)
        if shortage:
            self._pause(shortage)

    def step(self, item: Envelope) -> Sequence[Message]:
        """Record one packet."""
        header = item.message.header
        self._now_ns = max(self._now_ns, item.received_t_ns)
        if item.topic == "twin":
            self._cards[item.key] = item
        elif header.sequence < self._before.get((item.key, header.producer), 0):  # the bus still had it
            self._ledger.note_duplicated(item.key, header.producer)
            return ()
        if isinstance(item.message, Health):
            self._note_duplicated(item.message)
        self._put(item)
        return ()

    def tick(self, now_ns: int) -> Sequence[Message]:
        """Flush, begin a new part and look after the disk when it is time."""
        if now_ns < self._now_ns - LOOK_NS:  # the host's clock was set back: what was due by the old one never would be
            self._looked_ns = self._began_ns = now_ns
            self._paused_ns = min(self._paused_ns, now_ns)
            self._flushed_ns = now_ns - int(self._config.flush_interval_s * 1e9)
            self._unflushed_ns = None if self._unflushed_ns is None else self._flushed_ns  # due at once
        self._now_ns = now_ns
        if self._part and self._is_flush_due():
            self._unflushed_ns, self._flushed_ns = None, now_ns
            self._attempt(self._part.flush)
        if now_ns - self._looked_ns >= LOOK_NS:
            self._looked_ns = now_ns
            if self._part:
                self._watch_room()
            else:
                self._resume()
        if self._part and self._is_full(self._part):
            self._attempt(self._end_part)
            if not self._problem:
                self._attempt(lambda: self._begin({}))
        return ()

    def close(self) -> Sequence[Message]:
        """Finish the file; what could not be written is lost now."""
        if self._held:
            self._resume()
        if self._part:
            self._attempt(lambda: self._end_part(has_ended=True))
        self._counts["lost_unwritten"] += len(self._held)
        self._held.clear()
        return ()

    def abort(self) -> None:
        """Finish the file after a crash; it does not say that the recorder ended in order."""
        if self._part:
            self._attempt(self._end_part)

    def counters(self) -> Mapping[str, int]:
        """How many messages of each topic are in files for good, how many were lost because they could not be written,
        and what became of parts."""
        recorded = self._recorded + (self._part.written if self._part else Counter())
        return {f"recorded_{topic}": count for topic, count in recorded.items()} | self._counts

    def problem(self) -> str:
        """Why nothing is recorded now, if so."""
        return self._problem

    def _put(self, envelope: Envelope) -> None:
        if self._part is None:
            self._hold([envelope])
            return
        if self._unflushed_ns is None:
            self._unflushed_ns = min(envelope.received_t_ns, self._now_ns)
        try:
            self._part.add(envelope)
        except RecordingError as error:
            self._pause(str(error))

    def _attempt(self, action: Callable[[], None]) -> None:
        """Do something that the disk may refuse; then nothing is recorded until it no longer does."""
        try:
            action()
        except RecordingError as error:
            self._pause(str(error))

    def _begin(self, about: Mapping[str, str]) -> None:
        self._began_ns = min(self._held[0].received_t_ns, self._now_ns) if self._held else self._now_ns
        self._part = self._place.begin(self._began_ns, self._ledger, about)
        self._counts["parts"] += 1
        self._problem = ""
        for card in self._cards.values():
            self._part.add(card.received_at(self._began_ns))

    def _is_flush_due(self) -> bool:
        """By the next tick the oldest message would be too old; but behind a backlog, not at every tick."""
        interval_ns = self._config.flush_interval_s * 1e9
        return (
            self._unflushed_ns is not None
            and self._now_ns - self._unflushed_ns >= interval_ns - TICK_NS
            and self._now_ns - self._flushed_ns >= interval_ns / 4
        )

    def _is_full(self, part: OpenPart) -> bool:
        config = self._config
        return bool(
            (config.part_bytes and part.size >= config.part_bytes)
            or (config.part_s and self._now_ns - self._began_ns >= config.part_s * 1e9)
        )

    def _end_part(self, *, has_ended: bool = False) -> None:
        """End the open part, whatever the disk says. Raises RecordingError as it does."""
        assert self._part
        try:
            self._part.close(has_ended=has_ended)
        finally:
            self._let_go()

    def _let_go(self) -> None:
        if self._part:
            self._recorded += self._part.written
            self._ledger = self._ledger.following()
            unwritten, self._part, self._unflushed_ns = self._part.pending, None, None
            self._hold(unwritten)

    def _hold(self, unwritten: Sequence[Envelope]) -> None:
        """Keep messages until they can be recorded; when there are too many, the oldest are lost."""
        self._held.extend(unwritten)
        self._held_bytes += sum(len(envelope.payload) for envelope in unwritten)
        while self._held_bytes > HELD_BYTES:
            lost = self._held.popleft()
            self._held_bytes -= len(lost.payload)
            self._ledger.lose(lost.key, lost.message.header.producer, lost.message.header.sequence)
            self._counts["lost_unwritten"] += 1
            self._lost_in_pause += 1

    def _shortage(self, more_bytes: int) -> str:
        """What is wrong with the room on the disk, if anything; deletes the oldest part if that is allowed.

        One at a time: the room may come a little later. Raises RecordingError if the disk has gone.
        """
        wanted = self._config.min_free_bytes + more_bytes
        free = self._place.free_bytes()
        if free >= wanted:
            return ""
        deleted = self._place.delete_oldest() if self._config.delete_oldest else None
        if deleted is None:
            return (
                f"{free / 1e6:,.1f} MB are free on the disk, and {wanted / 1e6:,.1f} MB must be "
                "(see recorder.min_free_bytes): make room, or set recorder.delete_oldest"
            )
        self._counts["parts_deleted"] += 1
        _LOG.warning("%s: deleted, the oldest part, to make room (recorder.delete_oldest)", deleted)
        return ""

    def _watch_room(self) -> None:
        try:
            shortage = self._shortage(0)
        except RecordingError as error:
            shortage = str(error)
        if shortage:
            with suppress(RecordingError):  # why is known already
                self._end_part()
            self._pause(shortage)

    def _pause(self, why: str) -> None:
        self._let_go()
        if not self._problem:
            self._paused_ns, self._lost_in_pause = self._now_ns, 0
            self._paused_because = why
            self._counts["pauses"] += 1
            _LOG.error("nothing is recorded: %s", why)
        self._problem = f"NOTHING IS RECORDED: {why}; recording goes on by itself as soon as it can"

    def _resume(self) -> None:
        about = {
            "paused_t_ns": str(self._paused_ns),
            "resumed_t_ns": str(self._now_ns),
            "paused_because": self._paused_because,
            "lost_in_pause": str(self._lost_in_pause),
        }
        try:
            shortage = self._shortage(ROOM_TO_RESUME + self._held_bytes)
            if not shortage:
                self._begin(about)
        except RecordingError as error:
            shortage = str(error)
        if shortage:
            self._pause(shortage)
            return
        _LOG.warning(
            "recording goes on after %.1f s; messages lost meanwhile: %d",
            (self._now_ns - self._paused_ns) / 1e9,
            self._lost_in_pause,
        )
        held, self._held, self._held_bytes = self._held, deque(), 0
        for envelope in held:
            self._put(envelope)

    def _note_duplicated(self, health: Health) -> None:
        """Our own health, which the runner hands over before anything else, says what the bus brought twice."""
        if health.stage != STAGE.name:
            return
        self._own_producer = self._own_producer or health.header.producer
        if health.header.producer == self._own_producer:
            for line in health.inputs:
                before = self._duplicated.get((line.key, line.producer), 0)
                if line.producer and line.duplicated > before:  # no name: earlier producers, noted while they had one
                    self._ledger.note_duplicated(line.key, line.producer, line.duplicated - before)
                    self._duplicated[line.key, line.producer] = line.duplicated


def build(context: Context) -> Parts:
    """Mend what a killed recorder has left, and begin the first part.

    Raises:
        StageError: it cannot be written there.
    """
    config: RecorderConfig = context.config
    metadata, attachments = head_of(context)
    metadata["flush_interval_s"] = f"{config.flush_interval_s:g}"
    try:
        shelf = RecordingParts(context.run_folder / config.file, metadata, attachments, session=secrets.token_hex(4))
        for recovery in shelf.mended:
            found = recovery.found
            _LOG.warning(
                "a recorder had been killed; what it has recorded is kept as %s: %d messages; bytes of an unfinished "
                "chunk thrown away: %d",
                recovery.path,
                found.messages,
                found.thrown_away_bytes,
            )
        for path in shelf.unreadable:
            _LOG.warning("a recorder had been killed; what it has left cannot be mended, and is put aside as %s", path)
        for path in shelf.unmended:
            _LOG.warning(
                "a recorder had been killed; the disk refuses to mend what it has left, which stays %s: start again "
                "when it no longer does, or use `fantwin recover`",
                path,
            )
        return Parts(Recorder(shelf, config, context.started_t_ns))
    except RecordingError as error:
        raise StageError(f"{error} (recorder.file)") from error


def check(context: Context) -> list[str]:
    """A folder that the file cannot be written in, or a disk that is too full."""
    folder = (context.run_folder / context.config.file).parent
    existing = next(parent for parent in (folder, *folder.parents) if parent.exists())
    if not (existing.is_dir() and os.access(existing, os.W_OK | os.X_OK)):
        return [f"{folder}: {existing} is no folder this user may write in; change run_folder or recorder.file"]
    free, wanted = shutil.disk_usage(existing).free, context.config.min_free_bytes
    if free < wanted:
        return [
            f"{folder}: {free / 1e6:,.1f} MB are free, and nothing is recorded below {wanted / 1e6:,.1f} MB "
            "(recorder.min_free_bytes): make room"
        ]
    return []


STAGE = Stage(
    name="recorder",
    about="keeps every message, with configuration and twin, in MCAP files",
    reads=tuple(topic.name for topic in TOPICS if topic.recorded),
    writes=(),
    config=RecorderConfig,
    build=build,
    core_per_tray=False,
    wants_envelopes=True,
    check=check,
)
