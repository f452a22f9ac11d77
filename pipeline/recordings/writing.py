"""Writing recordings: MCAP files, whole at every moment as far as they go.

Metadata and attachments stand before the first message, so that a file that was torn off still says what it is. While
it is written a file is called NAME.mcap.active. See docs/recordings.md.
"""

from __future__ import annotations

import fcntl
import mimetypes
import os
from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial
from itertools import chain, count
from pathlib import Path
from types import TracebackType
from typing import Self

from mcap.data_stream import RecordBuilder
from mcap.records import DataEnd, Footer
from mcap.well_known import MessageEncoding
from mcap.writer import MCAP0_MAGIC
from mcap.writer import Writer as McapWriter
from mcap_protobuf.schema import register_schema

from pipeline.recordings.reading import METADATA_NAME, RecordingError, read_recording
from schemas.codec import encode, proto_type
from schemas.messages import Message, newest_t_ns
from schemas.topics import topic_of

ACTIVE_SUFFIX = ".active"
CHUNK_BYTES = (
    64 * 1024
)  # what is not yet in a finished chunk is lost in a crash, and a reader holds one chunk in memory


class _File:
    """A file in which every write is whole or has not been: on a full disk it keeps what it had."""

    def __init__(self, path: Path) -> None:
        """Open for writing; refuses a file that another process is writing. OSError if that cannot be done."""
        self._descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        try:
            fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)  # let go of by the system, even after kill -9
            os.ftruncate(self._descriptor, 0)
        except OSError:
            os.close(self._descriptor)
            raise
        self.size = 0

    def write(self, data: bytes) -> None:
        rest = memoryview(data)
        try:
            while rest:
                rest = rest[os.write(self._descriptor, rest) :]
        except OSError:
            os.ftruncate(self._descriptor, self.size)
            os.lseek(self._descriptor, self.size, os.SEEK_SET)
            raise
        self.size += len(data)

    def tell(self) -> int:
        return self.size

    def flush(self) -> None:
        """Nothing is held back: the system has it, and a killed process loses none of it."""

    def close(self) -> None:
        os.close(self._descriptor)


class RecordingWriter:
    """Writes one recording. Use it with `with`: an exception inside removes the unfinished file.

    When the disk refuses, the file is ended where it still was whole, and nothing more is written.
    """

    def __init__(
        self,
        path: Path,
        metadata: Mapping[str, str],
        attachments: Mapping[str, bytes] | None = None,
        *,
        t_ns: int = 0,
        overwrite: bool = False,
    ) -> None:
        """Begin `path`, under its active name.

        Without `overwrite`, a finished file of that name is left alone and this one becomes NAME-2.mcap, and so on.
        What a killed recorder has left under the active name is kept in the same way: see `left_over`.

        Args:
            path: NAME.mcap.
            metadata: what the recording is about, see docs/recordings.md.
            attachments: name -> content.
            t_ns: when it begins, ns since 1970.
            overwrite: replace a finished file.

        Raises:
            RecordingError: it cannot be written there, or another process is writing it.
        """
        self.path = path
        self.left_over: Path | None = None
        """the name now borne by what a killed recorder had left"""
        self.written: Counter[str] = Counter()
        """messages of each topic that are in the file for good"""
        self.pending: Counter[str] = Counter()
        """messages of each topic in the chunk that is not written yet"""
        self._overwrite = overwrite
        self._ended = False
        self._channels: dict[str, tuple[int, str]] = {}
        self._schemas: dict[type[Message], int] = {}
        self._active = path.with_name(path.name + ACTIVE_SUFFIX)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self.left_over = _keep_left_over(self._active, path)
            self._file = _File(self._active)
        except BlockingIOError as error:
            raise RecordingError(
                f"{self._active}: another recorder is writing it; stop it, or name another file"
            ) from error
        except OSError as error:
            raise RecordingError(f"{path}: cannot be written: {error.strerror}; name another file or folder") from error
        self._mcap = McapWriter(self._file, chunk_size=CHUNK_BYTES)  # type: ignore[arg-type]  it wants a stream of any kind
        try:
            self._mcap.start(profile="", library="fantwin")
            self._mcap.add_metadata(METADATA_NAME, dict(metadata))
            for name, content in (attachments or {}).items():
                self._mcap.add_attachment(t_ns, t_ns, name, _media_type(name), content)
        except OSError as error:
            self.discard()
            raise RecordingError(f"{path}: cannot be written: {error.strerror}; name another file or folder") from error

    def write(self, key: str, payload: bytes, message: Message, log_time_ns: int) -> None:
        """Add a message: the key it came on, its bytes, and when it was received.

        Raises:
            RecordingError: the disk refuses; `pending` then counts what did not get into the file.
        """
        channel, topic = self._channels.get(key) or self._register(key, type(message))
        self.pending[topic] += 1
        self._put(
            partial(
                self._mcap.add_message,
                channel,
                max(0, log_time_ns),  # MCAP has no time before 1970; the message itself keeps it
                payload,
                max(0, newest_t_ns(message)),
                message.header.sequence % 2**32,  # a field of 32 bits in MCAP
            )
        )

    def write_message(self, key: str, message: Message, log_time_ns: int) -> None:
        """The same for a message that has not been on the bus."""
        self.write(key, encode(message), message, log_time_ns)

    def flush(self) -> None:
        """Close the chunk: what has been written until now survives a crash of this process.

        Raises:
            RecordingError: as in `write`.
        """
        if self.pending:
            self._put(self._mcap.flush)

    def close(self) -> None:
        """Finish the file and give it its name, `path`. Does nothing to a file that has already been ended.

        Raises:
            RecordingError: as in `write`.
        """
        if self._ended:
            return
        self._put(self._mcap.finish)
        self._hand_over()

    def discard(self) -> None:
        """Remove the unfinished file."""
        if not self._ended:
            self._ended = True
            self._active.unlink()
            self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        if kind is None:
            self.close()
        else:
            self.discard()

    def _register(self, key: str, message_type: type[Message]) -> tuple[int, str]:
        if message_type not in self._schemas:
            self._schemas[message_type] = register_schema(self._mcap, proto_type(message_type))
        channel = self._mcap.register_channel(key, MessageEncoding.Protobuf, self._schemas[message_type])
        self._channels[key] = (channel, topic_of(key).name)
        return self._channels[key]

    def _put(self, write: Callable[[], None]) -> None:
        """Let MCAP write, and note whether it has closed a chunk."""
        before = self._file.size
        try:
            write()
        except OSError as error:
            self._note_written(before)
            self._end_short()
            raise RecordingError(
                f"{self.path}: cannot be written any more: {error.strerror}; it ends here and is readable: make room "
                "and start the recorder again"
            ) from error
        self._note_written(before)

    def _note_written(self, before: int) -> None:
        if self._file.size != before:
            self.written += self.pending
            self.pending.clear()

    def _end_short(self) -> None:
        """End the file at its last whole record, without a summary: forty bytes, where a summary may need thousands."""
        ending = RecordBuilder()
        DataEnd(0).write(ending)
        Footer(summary_start=0, summary_offset_start=0, summary_crc=0).write(ending)
        with suppress(OSError):  # without them the file is readable all the same, by readers that bear a torn file
            self._file.write(ending.end() + MCAP0_MAGIC)
        self._hand_over()

    def _hand_over(self) -> None:
        self._ended = True
        if not self._overwrite:
            self.path = free_name(self.path)
        try:
            self._active.replace(self.path)
        except OSError as error:
            raise RecordingError(
                f"{self.path}: the recording cannot be given its name: {error.strerror}; it stays {self._active.name}"
            ) from error
        finally:
            self._file.close()


def free_name(path: Path) -> Path:
    """`path` if there is no such file, or else the first of NAME-2, NAME-3 ... that is free."""
    names = chain([path], (path.with_stem(f"{path.stem}-{number}") for number in count(2)))
    return next(name for name in names if not name.exists())


def _keep_left_over(active: Path, path: Path) -> Path | None:
    """Give what a killed recorder has left the name of a recording; one without any message is not worth it."""
    try:
        descriptor = os.open(active, os.O_RDWR | os.O_CLOEXEC)
    except FileNotFoundError:
        return None
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        try:
            worth = any(True for _ in read_recording(active))
        except RecordingError:
            worth = False
        return active.rename(free_name(path)) if worth else None
    finally:
        os.close(descriptor)


def _media_type(name: str) -> str:
    return mimetypes.guess_type(name)[0] or "application/octet-stream"
