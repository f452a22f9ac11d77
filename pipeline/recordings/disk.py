"""The disk that recordings lie on: files whose writes are whole or not at all, and how much room there is."""

from __future__ import annotations

import errno
import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from pipeline.recordings.records import RecordingError

_PASSING = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.ENODEV, errno.ENXIO, errno.EROFS, errno.ESTALE)


class DiskError(RecordingError):
    """The disk refuses for now: it is full, or it has gone. It may be there again later."""


def refused(what: str, error: OSError, advice: str) -> RecordingError:
    """What the system has refused as a recording's error in one line; a `DiskError` where that may pass."""
    kind = DiskError if error.errno in _PASSING else RecordingError
    return kind(f"{what}: {error.strerror}; {advice}")


class AtomicAppendFile:
    """A file in which every write is whole or has not been: on a full disk it keeps what it had."""

    def __init__(self, path: Path, *, keep: bool = False) -> None:
        """Open for writing, at its end if its content is to be kept and empty otherwise.

        Raises:
            BlockingIOError: another process is writing it.
            OSError: it cannot be opened; with `keep` it must exist.
        """
        flags = os.O_RDWR | os.O_CLOEXEC | (0 if keep else os.O_CREAT)
        self._descriptor = os.open(path, flags, 0o644)
        try:
            fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)  # let go of by the system, even after kill -9
            self.size = os.fstat(self._descriptor).st_size if keep else 0
            self.cut(self.size)
        except OSError:
            os.close(self._descriptor)
            raise
        self._is_synced = False

    def write(self, data: bytes) -> None:
        """Append. OSError if the system refuses; the file is then as it was."""
        rest = memoryview(data)
        self._is_synced = False
        try:
            while rest:
                rest = rest[os.write(self._descriptor, rest) :]
        except OSError:
            self.cut(self.size)
            raise
        self.size += len(data)

    def cut(self, size: int) -> None:
        """Shorten it to `size` bytes, where the next write goes."""
        os.ftruncate(self._descriptor, size)
        os.lseek(self._descriptor, size, os.SEEK_SET)
        self.size = size

    def sync(self) -> None:
        """Through to the disk: what has been written survives a power cut."""
        if not self._is_synced:
            os.fdatasync(self._descriptor)
            self._is_synced = True

    def close(self) -> None:
        """Let go of it."""
        os.close(self._descriptor)


@contextmanager
def unwritten(path: Path) -> Iterator[None]:
    """Nobody writes the file as long as the block lasts.

    Raises:
        BlockingIOError: another process is writing it.
        OSError: it cannot be read.
    """
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
        yield
    finally:
        os.close(descriptor)


def sync_folder(folder: Path) -> None:
    """Through to the disk: the names in a folder survive a power cut. OSError if that cannot be done."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


class Disk:
    """The disk under a folder. Should it be unmounted, its place is not taken for it."""

    def __init__(self, folder: Path) -> None:
        """The folder must exist. OSError otherwise."""
        self._folder = folder.resolve(strict=True)
        self._mounted_at = next(place for place in (self._folder, *self._folder.parents) if place.is_mount())

    def free_bytes(self) -> int:
        """How much room there is for this user.

        Raises:
            DiskError: the disk is not there.
        """
        try:
            if not self._mounted_at.is_mount():
                raise DiskError(f"{self._mounted_at}: the disk is no longer mounted; mount it again")
            found = os.statvfs(self._folder)
        except OSError as error:
            raise DiskError(f"{self._folder}: the folder is gone: {error.strerror}; bring it back") from error
        return found.f_bavail * found.f_frsize
