"""The disk that recordings are on: files that are written whole or not at all, and the free space."""

from __future__ import annotations

import errno
import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from fantwin.pipeline.recordings.records import RecordingError

LEAST_FREE_BYTES, LEAST_FREE_SHARE = 100_000_000, 1 / 8
"""space to leave free on a disk for other programs, and of a small disk this share of it"""
_COPY_BYTES = 1 << 20
_MAY_PASS = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.ENODEV, errno.ENXIO, errno.EROFS, errno.ESTALE)


class DiskError(RecordingError):
    """The disk is full, or is not there. It may accept writes again later."""


def refused(what: str, error: OSError, advice: str) -> RecordingError:
    """An error of the operating system as a RecordingError of one line; a DiskError if it may pass."""
    kind = DiskError if error.errno in _MAY_PASS else RecordingError
    return kind(f"{what}: {error.strerror}; {advice}")


def least_free_bytes(disk_bytes: int) -> int:
    """Space to leave free on a disk of this size."""
    return round(min(LEAST_FREE_BYTES, LEAST_FREE_SHARE * disk_bytes))


class AtomicAppendFile:
    """A file that every write extends completely or not at all: on a full disk it keeps what it had.

    It is locked: one process at a time writes it.
    """

    def __init__(self, path: Path, *, keep: bool = False) -> None:
        """Open for writing: at its end with `keep`, else empty.

        Raises:
            BlockingIOError: another process is writing it.
            OSError: it cannot be opened, or does not exist and `keep` is set.
        """
        self._descriptor = _open_locked(path, os.O_RDWR | (0 if keep else os.O_CREAT))
        try:
            self.size = os.fstat(self._descriptor).st_size if keep else 0
            self.cut(self.size)
        except OSError:
            os.close(self._descriptor)
            raise
        self._is_synced = False

    def write(self, data: bytes) -> None:
        """Append. OSError if the system refuses; the file is then unchanged."""
        rest = memoryview(data)
        try:
            while rest:
                self._is_synced = False
                rest = rest[os.write(self._descriptor, rest) :]
        except OSError:
            self.cut(self.size)
            raise
        self.size += len(data)

    def tell(self) -> int:
        """Where the next write goes."""
        return self.size

    def flush(self) -> None:
        """Nothing: every write goes to the system at once."""

    def cut(self, size: int) -> None:
        """Shorten it to `size` bytes; the next write goes there."""
        os.ftruncate(self._descriptor, size)
        os.lseek(self._descriptor, size, os.SEEK_SET)
        self.size = size

    def sync(self) -> None:
        """Flush to the disk: what has been written then survives a power cut."""
        if not self._is_synced:
            os.fdatasync(self._descriptor)
            self._is_synced = True

    def is_at(self, path: Path) -> bool:
        """Whether `path` is still this file: not deleted, moved or replaced. OSError if the system cannot say."""
        try:
            found = path.stat()
        except (FileNotFoundError, NotADirectoryError):
            return False
        return os.path.samestat(found, os.fstat(self._descriptor))

    def is_cut(self) -> bool:
        """Whether somebody else has shortened it."""
        return os.fstat(self._descriptor).st_size < self.size

    def move_to(self, path: Path) -> None:
        """Copy the content to a new file, flush that to the disk, and write there from now on. What was written can
        still be read here after the file was deleted.

        Raises:
            FileExistsError: there is a file at `path`; it is left alone.
            OSError: the disk refuses; nothing has changed.
        """
        descriptor = _open_locked(path, os.O_RDWR | os.O_CREAT | os.O_EXCL)
        try:
            for start in range(0, self.size, _COPY_BYTES):
                length = min(_COPY_BYTES, self.size - start)
                rest = memoryview(os.pread(self._descriptor, length, start))
                if len(rest) < length:
                    raise OSError(errno.EIO, "it has been cut")
                while rest:
                    rest = rest[os.write(descriptor, rest) :]
            os.fdatasync(descriptor)
        except OSError:
            path.unlink(missing_ok=True)
            os.close(descriptor)
            raise
        os.close(self._descriptor)
        self._descriptor, self._is_synced = descriptor, True

    def close(self) -> None:
        """Close and unlock it."""
        os.close(self._descriptor)


def _open_locked(path: Path, flags: int) -> int:
    descriptor = os.open(path, flags | os.O_CLOEXEC, 0o644)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)  # the system unlocks it, also after kill -9
    except OSError:
        os.close(descriptor)
        raise
    return descriptor


@contextmanager
def not_being_written(path: Path) -> Iterator[None]:
    """Keep others from writing the file inside the `with` block.

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


def is_being_written(path: Path) -> bool:
    """Whether another process is writing the file. False if it cannot be opened: reading it reports that."""
    try:
        with not_being_written(path):
            return False
    except BlockingIOError:
        return True
    except OSError:
        return False


class Disk:
    """The disk that a folder is on. Its mount point is not mistaken for it after it was unmounted."""

    def __init__(self, folder: Path) -> None:
        """The folder must exist. OSError otherwise."""
        resolved = folder.resolve(strict=True)
        self._mounted_at = next(path for path in (resolved, *resolved.parents) if path.is_mount())

    def is_mounted(self) -> bool:
        """Whether the disk is there."""
        return self._mounted_at.is_mount()

    def free_bytes(self) -> int:
        """Free space for this user.

        Raises:
            DiskError: the disk is not there.
        """
        found = self._state()
        return found.f_bavail * found.f_frsize

    def size_bytes(self) -> int:
        """Size of its file system.

        Raises:
            DiskError: the disk is not there, or its file system does not say its size, such as some of FUSE.
        """
        found = self._state()
        if not found.f_blocks:
            raise DiskError(
                f"{self._mounted_at}: the file system does not say its size, which the limits of recordings need; "
                "name a folder of another one"
            )
        return found.f_blocks * found.f_frsize

    def _state(self) -> os.statvfs_result:
        try:
            if not self.is_mounted():
                raise DiskError(f"{self._mounted_at}: the disk is no longer mounted; mount it again")
            return os.statvfs(self._mounted_at)
        except OSError as error:
            raise DiskError(f"{self._mounted_at}: the disk cannot be used: {error.strerror}; mount it again") from error
