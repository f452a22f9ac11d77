"""Messages on disk that a producer no longer keeps in memory, for consumers that a cut separates from it for long.

A process has one spool for all of its publishers, in files of its own: each has messages of one publisher, and is
removed when it is too old, when all files together are too large, and when the process ends in order. What a process
left that was killed is removed when it is started again: its messages can no longer be asked of it.

The disk can never do worse than lose what would be lost without a spool: an error becomes one line in health.
"""

from __future__ import annotations

import shutil
import struct
import threading
import time
import zlib
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

_HEADER = struct.Struct("<IIQ")
"""of each message in a file: its length, its checksum and its sequence number"""
FILE_BYTES, FILE_S = 1 << 20, 30.0
"""of a file, which is removed as a whole: its size, unless it has a single message, and the time from first to last"""
WRITTEN_AGAIN_S = 10.0
"""how long nothing is written after an error of the disk"""
DAMAGE_SHOWN_S = 60.0


@dataclass(slots=True, eq=False)
class _File:
    """Messages of one publisher, in the order of their numbers."""

    path: Path
    first: int
    last: int
    bytes: int
    began_s: float
    newest_s: float
    is_removed: bool = False


class Spool:
    """The files of one process. Thread-safe."""

    def __init__(
        self, folder: Path, most_bytes: int, most_s: float, now_s: Callable[[], float] = time.monotonic
    ) -> None:
        """folder: of this process alone; what is in it is removed. most_s: how long a message is kept."""
        self._folder = folder
        self._most_bytes, self._most_s = most_bytes, most_s
        self._file_bytes = min(FILE_BYTES, max(1, most_bytes // 16))
        self._file_s = min(FILE_S, most_s / 16)
        self._now_s = now_s
        self._lock = threading.Lock()
        self._files: deque[_File] = deque()
        self._bytes = 0
        self._made = 0
        self._unwritable = ""
        self._again_s = 0.0
        self._damage = ""
        self._damaged_s = 0.0
        self.removed = sum(path.is_file() for path in folder.glob("*")) if folder.is_dir() else 0
        """files that an earlier process had left"""
        shutil.rmtree(folder, ignore_errors=True)

    def stream(self) -> SpooledStream:
        """The place of the messages of one more publisher."""
        return SpooledStream(self)

    def problem(self) -> str:
        """What is wrong with the disk or the files, for people; empty if nothing."""
        with self._lock:
            shown = self._damage if self._now_s() - self._damaged_s < DAMAGE_SHOWN_S else ""
            return "; ".join(filter(None, (self._unwritable, shown)))

    def note(self) -> str:
        """What is on disk, for people; empty if there is nothing to say."""
        with self._lock:
            kept = f"{self._bytes / 1e6:.0f} MB of messages are kept on disk" if self._files else ""
        left = f"{self.removed} files of messages that an earlier process had kept were removed" if self.removed else ""
        return "; ".join(filter(None, (kept, left)))

    def close(self) -> None:
        """Remove all files."""
        with self._lock:
            for file in self._files:
                file.is_removed = True
            self._files.clear()
            self._bytes = 0
        shutil.rmtree(self._folder, ignore_errors=True)
        with suppress(OSError):
            self._folder.parent.rmdir()  # if no other process of this run folder has files there

    def begin(self, first: int) -> tuple[_File, BinaryIO] | None:
        """A new file; None if the disk takes none now."""
        with self._lock:
            now_s = self._now_s()
            if now_s < self._again_s:
                return None
            self._made += 1
            path = self._folder / f"{self._made}.spool"
            try:
                self._folder.mkdir(parents=True, exist_ok=True)
                opened = path.open("wb")
            except OSError as error:
                self._fail(error)
                return None
            file = _File(path, first, first - 1, 0, now_s, now_s)
            self._files.append(file)
            return file, opened

    def grow(self, file: _File, sequence: int, size: int) -> bool:
        """A message was written. Returns whether another one may follow in the same file. Removes what is too much."""
        with self._lock:
            if file.is_removed:  # by another stream since this one wrote to it: the message is gone as well
                return False
            file.last, file.newest_s = sequence, self._now_s()
            file.bytes += size
            self._bytes += size
            self._unwritable = ""
            while self._files and self._files[0] is not file and self._is_too_much(self._files[0]):
                self._remove(self._files.popleft())
            return file.bytes < self._file_bytes and file.newest_s - file.began_s < self._file_s

    def fail(self, error: OSError) -> None:
        """A message could not be written."""
        with self._lock:
            self._fail(error)

    def is_kept(self, file: _File) -> bool:
        """Whether a file has not been removed, for its size or its age."""
        with self._lock:
            return not file.is_removed

    def damaged(self, file: _File) -> None:
        """A file does not hold what was written."""
        with self._lock:
            self._damage = f"messages that were kept on disk cannot be read again ({file.path}): check the disk"
            self._damaged_s = self._now_s()

    def _is_too_much(self, oldest: _File) -> bool:
        return self._bytes > self._most_bytes or self._now_s() - oldest.newest_s > self._most_s

    def _remove(self, file: _File) -> None:
        self._bytes -= file.bytes
        file.is_removed = True
        file.path.unlink(missing_ok=True)

    def _fail(self, error: OSError) -> None:
        self._again_s = self._now_s() + WRITTEN_AGAIN_S
        why = error.strerror or type(error).__name__
        self._unwritable = (
            f"messages cannot be kept on disk in {self._folder} ({why}): a long cut may lose some; make room "
            "there, or let this user write there"
        )


class SpooledStream:
    """The messages of one publisher that are on disk. One thread adds; any may read."""

    def __init__(self, spool: Spool) -> None:
        self._spool = spool
        self._files: deque[_File] = deque()
        self._opened: BinaryIO | None = None

    def add(self, sequence: int, payload: bytes) -> None:
        """Keep a message; their numbers grow."""
        if self._opened is not None and not self._spool.is_kept(self._files[-1]):
            self._close()
        if self._opened is None:
            begun = self._spool.begin(sequence)
            if begun is None:
                return
            self._files = deque(each for each in self._files if self._spool.is_kept(each))
            self._files.append(begun[0])
            self._opened = begun[1]
        file = self._files[-1]
        try:
            self._opened.write(_HEADER.pack(len(payload), zlib.crc32(payload), sequence))
            self._opened.write(payload)
            self._opened.flush()
        except OSError as error:
            self._spool.fail(error)
            self._close()
            return
        if not self._spool.grow(file, sequence, _HEADER.size + len(payload)):
            self._close()

    def read(self, first: int, end: int) -> Iterator[bytes]:
        """The messages that are on disk of those from number `first` until before `end`."""
        for file in tuple(self._files):
            if file.first < end and file.last >= first:
                yield from self._read(file, first, end)

    def _read(self, file: _File, first: int, end: int) -> Iterator[bytes]:
        last = file.last
        try:
            content = file.path.read_bytes()
        except OSError:
            if self._spool.is_kept(file):
                self._spool.damaged(file)
            return
        place = 0
        while place + _HEADER.size <= len(content):
            size, checksum, sequence = _HEADER.unpack_from(content, place)
            payload = content[place + _HEADER.size : place + _HEADER.size + size]
            if len(payload) < size or zlib.crc32(payload) != checksum:
                break
            place += _HEADER.size + size
            if first <= sequence < end:
                yield payload
            if sequence >= last:
                return
        self._spool.damaged(file)

    def _close(self) -> None:
        opened, self._opened = self._opened, None
        if opened is not None:
            try:
                opened.close()
            except OSError as error:
                self._spool.fail(error)
