"""Writing recordings: MCAP files that are readable at any moment up to the last flush.

Metadata and attachments come before the first message, so that a truncated file still says what it is; the ledger comes
after the last. While a file is written it is called NAME.mcap.active. See docs/reference/recordings.md.
"""

from __future__ import annotations

import mimetypes
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from functools import cache
from itertools import chain, count
from pathlib import Path
from types import TracebackType
from typing import IO, NoReturn, Self, cast

from mcap.well_known import MessageEncoding, SchemaEncoding
from mcap.writer import Writer
from mcap_protobuf.schema import build_file_descriptor_set

from fantwin.pipeline.files import sync_folder
from fantwin.pipeline.recordings.disk import AtomicAppendFile, Disk, refused
from fantwin.pipeline.recordings.ending import write_short_ending
from fantwin.pipeline.recordings.records import (
    FORMAT_KEY,
    MADE_BY_KEY,
    MESSAGE,
    METADATA_NAME,
    RECORD,
    RecordingError,
    active_path,
    this_program,
)
from fantwin.pipeline.recordings.sequence_ledger import BEFORE_NAME, LEDGER_NAME, SequenceLedger, ledger_metadata
from fantwin.schemas.codec import proto_type, type_name
from fantwin.schemas.envelope import Envelope
from fantwin.schemas.formats import RECORDING
from fantwin.schemas.health import Health
from fantwin.schemas.messages import Message
from fantwin.schemas.topics import HEALTH, topic_of

CHUNK_BYTES = 256 * 1024
"""A crash loses what is not in a finished chunk; a reader holds one chunk in memory."""
UNSYNCED_BYTES = 4 << 20
"""About the most that is kept in memory until it is flushed to the disk."""
_MESSAGE_BYTES = RECORD.size + MESSAGE.size


class RecordingWriter:
    """Writes one recording. Use it with `with`: an exception inside removes the unfinished file.

    When the disk refuses a write, the file ends after what is on the disk, and nothing more is written.
    """

    def __init__(
        self,
        path: Path,
        metadata: Mapping[str, str],
        attachments: Mapping[str, bytes] | None = None,
        *,
        t_ns: int = 0,
        overwrite: bool = False,
        ledger: SequenceLedger | None = None,
    ) -> None:
        """Begin `path`, under its active name. A file that a killed process left under that name is overwritten;
        `pipeline.recordings.parts` repairs it first.

        Without `overwrite`, a finished file of that name is kept and this one becomes NAME-2.mcap, and so on.

        Args:
            path: NAME.mcap.
            metadata: about the recording, see docs/reference/recordings.md. Its format number is added, and this
                version of fantwin as its maker if they name none.
            attachments: name -> content.
            t_ns: time of the attachments, ns since 1970.
            overwrite: replace a finished file.
            ledger: one that continues the parts before.

        Raises:
            DiskError: the disk is full, or is not there.
            RecordingError: it cannot be written there, or another process is writing it.
        """
        self.path = path
        self.ledger = ledger or SequenceLedger()
        self.written: Counter[str] = Counter()
        """messages of each topic that are flushed to the disk"""
        self.restored = 0
        """how often another program had deleted, moved or replaced the file, and its content was written again; its
        user sets it back"""
        self.lost = 0
        """messages that were flushed and are lost with the file, because it could not be restored"""
        self._filling: list[Envelope] = []
        """the messages of the chunk that is not written yet"""
        self._unsynced: list[Envelope] = []
        """the messages that are written and may not be on the disk yet"""
        self._unsynced_bytes = 0
        self.before_chunk: Callable[[], object] | None = None
        """is called before messages are written to the disk"""
        self._overwrite = overwrite
        self._ended = False
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self._chunk_bytes = 0
        self._active = active_path(path)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._disk = Disk(path.parent)
            self._file = AtomicAppendFile(self._active)
        except BlockingIOError as error:
            raise RecordingError(
                f"{self._active}: another recorder is writing it; stop it, or name another file"
            ) from error
        except OSError as error:
            raise refused(f"{path}: cannot be written", error, "name another file or folder") from error
        try:
            # a chunk ends by `flush` alone: what a refused write has cost is then known
            self._writer = Writer(cast(IO[bytes], self._file), chunk_size=sys.maxsize)
            self._writer.start(profile="", library="fantwin")
            about = {MADE_BY_KEY: this_program(), **metadata, FORMAT_KEY: str(RECORDING.written)}
            self._writer.add_metadata(METADATA_NAME, about)
            if self.ledger.next:
                self._writer.add_metadata(BEFORE_NAME, self.ledger.before_as_metadata())
            for name, content in (attachments or {}).items():
                self._writer.add_attachment(t_ns, t_ns, name, _media_type(name), content)
            sync_folder(path.parent)
            self._synced_size = self._file.size
        except OSError as error:
            with suppress(OSError):  # the disk may refuse that as well
                self.discard()
            raise refused(f"{path}: cannot be written", error, "name another file or folder") from error

    @property
    def size(self) -> int:
        """Size of the file in bytes."""
        return self._file.size

    @property
    def pending(self) -> list[Envelope]:
        """The messages that are not flushed to the disk, in order."""
        return [*self._unsynced, *self._filling]

    def add(self, envelope: Envelope) -> None:
        """Add a message. MCAP has no times before 1970 (the message itself keeps them) and a 32 bit sequence.

        Raises:
            RecordingError: the disk refuses; `pending` then has the messages that are not in the file.
        """
        payload = envelope.payload
        self._writer.add_message(
            self._channels.get(envelope.key) or self._register_channel(envelope.key),
            max(0, envelope.received_t_ns),
            payload,
            max(0, envelope.newest_t_ns),
            envelope.header.sequence & 0xFFFFFFFF,
        )
        self._filling.append(envelope)
        self._chunk_bytes += len(payload) + _MESSAGE_BYTES
        if self._chunk_bytes > CHUNK_BYTES:
            self._finish_chunk()
            if self._unsynced_bytes > UNSYNCED_BYTES:
                self._sync()

    def add_message(self, key: str, message: Message, received_t_ns: int) -> None:
        """Add a message that has not been on the bus. Raises RecordingError as `add` does."""
        self.add(Envelope.of(key, message, received_t_ns))

    def flush(self) -> None:
        """Flush to the disk: all messages added until now survive a crash, of the machine too.

        Raises:
            RecordingError: as in `add`.
        """
        self._finish_chunk()
        self._sync()

    def stay_in_place(self) -> None:
        """Restore the file if another program has deleted, moved or replaced it.

        Raises:
            RecordingError: it cannot be restored, or was cut: what was flushed is lost (`lost`, `ledger.as_lost`); what
                was not flushed is pending.
        """
        try:
            if self._file.is_cut():
                self._lose("another program has cut it")
            elif not self._file.is_at(self._active) and self._disk.is_mounted():
                self._restore()
        except OSError as error:  # whatever is not known to be on the disk is pending again
            self._take_back()
            raise self._end_early(error) from error

    def finish(self, *, has_ended: bool = False) -> None:
        """End the file and give it its name, `path`. Does nothing if the file has already ended.

        has_ended: the recorder stops with this file; what was published and has not come is then missing.

        Raises:
            RecordingError: as in `add`.
        """
        if self._ended:
            return
        self.flush()
        if has_ended:
            self.ledger.finish()
        try:
            self._writer.add_metadata(LEDGER_NAME, ledger_metadata(self.ledger.counts, has_ended=has_ended))
            self._writer.finish()
            self._file.sync()
        except OSError as error:
            self._take_back()
            raise self._end_early(error) from error
        self._rename()

    def discard(self) -> None:
        """Remove the unfinished file."""
        if not self._ended:
            self._ended = True
            try:
                self._active.unlink()
            finally:
                self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        if kind is None:
            self.finish()
        else:
            self.discard()

    def _register_channel(self, key: str) -> int:
        message_type = topic_of(key).message
        name = type_name(message_type)
        if name not in self._schemas:
            data = _schema(message_type)
            self._schemas[name] = self._writer.register_schema(name, SchemaEncoding.Protobuf, data)
            self._chunk_bytes += len(data)
        self._channels[key] = self._writer.register_channel(key, MessageEncoding.Protobuf, self._schemas[name])
        return self._channels[key]

    def _finish_chunk(self) -> None:
        if not self._filling:
            return
        if self.before_chunk:
            self.before_chunk()
        self.stay_in_place()  # before writing: a write to a file that was cut would hide that
        start = self._file.size
        try:
            self._writer.flush()
        except OSError as error:
            with suppress(OSError):
                self._file.cut(start)
            self._sync()  # the chunks before it are still saved
            raise self._end_early(error) from error
        self._unsynced += self._filling
        self._unsynced_bytes += self._chunk_bytes
        self._filling, self._chunk_bytes = [], 0

    def _sync(self) -> None:
        """Flush what is written to the disk; it counts as recorded from then on."""
        try:
            self._file.sync()
        except OSError as error:  # the system drops what it could not write: a second attempt proves nothing
            self._take_back()
            raise self._end_early(error) from error
        self.stay_in_place()
        for envelope in self._unsynced:
            header = envelope.header
            self.ledger.add(envelope.key, header.producer, header.sequence, envelope.received_t_ns)
            if envelope.topic == HEALTH:
                assert isinstance(envelope.message, Health)
                self.ledger.add_health(envelope.message)
        self.written.update(envelope.topic for envelope in self._unsynced)
        self._unsynced, self._unsynced_bytes, self._synced_size = [], 0, self._file.size

    def _take_back(self) -> None:
        """Remove what may not be on the disk from the file; it is pending again."""
        self._filling, self._unsynced = self.pending, []
        with suppress(OSError):
            self._file.cut(self._synced_size)

    def _restore(self) -> None:
        for path in _part_names(self.path):  # where another file has taken its name, under the next one
            active = active_path(path)
            if path == self.path or not path.exists():
                try:
                    path.parent.mkdir(parents=True, exist_ok=True)
                    self._file.move_to(active)
                    sync_folder(active.parent)
                except FileExistsError:
                    continue
                except OSError as error:
                    self._lose(f"it was deleted, moved or replaced and cannot be restored: {error.strerror}")
                self.path, self._active = path, active
                self.restored += 1
                return

    def _lose(self, why: str) -> NoReturn:
        """End writing; what is in the file is lost, and what is not flushed is pending."""
        self._filling, self._unsynced, self._ended = self.pending, [], True
        self._file.close()
        self.lost, self.written = self.written.total() - self.written["twin"], Counter()
        raise RecordingError(
            f"{self._active}: {why}; messages lost with it: {self.lost}; keep other programs away from it"
        )

    def _end_early(self, error: OSError) -> RecordingError:
        """End the file after what is on the disk, without an index. Returns the error to raise."""
        write_short_ending(self._file, ledger_metadata(self.ledger.counts))
        self._rename()
        return refused(
            f"{self.path}: cannot be written any more", error, "it ends here and is readable: make room on the disk"
        )

    def _rename(self) -> None:
        self._ended = True
        if not self._overwrite:
            self.path = free_name(self.path)
        try:
            self._active.replace(self.path)
            sync_folder(self.path.parent)
        except OSError as error:
            raise refused(
                f"{self.path}: the recording cannot be given its name", error, f"it stays {self._active.name}"
            ) from error
        finally:
            self._file.close()


@cache
def _schema(message_type: type[Message]) -> bytes:
    return build_file_descriptor_set(proto_type(message_type)).SerializeToString()


def free_name(path: Path) -> Path:
    """`path`, or if it exists the first of NAME-2, NAME-3 ... that does not."""
    return next(name for name in _part_names(path) if not name.exists())


def _part_names(path: Path) -> Iterator[Path]:
    return chain([path], (path.with_stem(f"{path.stem}-{number}") for number in count(2)))


def _media_type(name: str) -> str:
    return mimetypes.guess_type(name)[0] or "application/octet-stream"
