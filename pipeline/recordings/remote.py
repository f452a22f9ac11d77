"""Recordings at URLs, such as s3://bucket/site/day.mcap, wherever fsspec can read (extra `remote`).

A path whose bytes are elsewhere: its text is the URL, and everything that reads a recording opens it like a file.
Inside `local_copies` a recording is fetched once and read from there, since most work reads it several times.
"""

from __future__ import annotations

import hashlib
import io
import re
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path, PosixPath
from tempfile import TemporaryDirectory
from typing import IO, Any

from pipeline.errors import UsageError
from pipeline.optional_dependencies import how_to_install, is_installed
from pipeline.recordings.records import RecordingError

_BLOCK_BYTES = 1 << 20
"""fetched at a time where no copy is made"""
_MAY_BE_SECRET = re.compile(r"://[^/@]*:[^/@]*@|https?://[^/@]*@|\?")
"""a password, a token, or a query, such as a signature"""
_COPIES: ContextVar[Path | None] = ContextVar("copies", default=None)
"""the folder of local copies; None: there are none"""


def recording_path(text: str) -> Path:
    """The path of a recording on the command line: a file, or a URL.

    Raises:
        UsageError: the extra for URLs is missing, or the URL may hold a secret.
    """
    if "://" not in text:
        return Path(text)
    if text.startswith("file://"):
        return Path(text.removeprefix("file://"))
    if _MAY_BE_SECRET.search(text):
        raise UsageError(
            f"{text.partition('://')[0]}://...: names of recordings are printed and written into cards, so a URL "
            "may hold no password and no `?`: give credentials as the tools of the store take them"
        )
    if not is_installed("fsspec"):
        raise UsageError(f"{text}: recordings at URLs need the extra `remote`; {how_to_install('remote')}")
    return RemotePath(text)


def matching(paths: Sequence[Path] | None) -> list[Path]:
    """The same, with each URL that has wildcards replaced by those that match, in order: no shell does that.

    Raises:
        RecordingError: none match, or the store cannot be read.
    """
    return [match for path in paths or () for match in _matches(path)]


def _matches(path: Path) -> list[Path]:
    if not (isinstance(path, RemotePath) and "*" in str(path)):
        return [path]
    filesystem, pattern = path.place()
    try:
        found = sorted(map(str, filesystem.glob(pattern)))
    except Exception as error:
        raise path.unreadable(error) from error
    if not found:
        raise RecordingError(f"{path}: no file matches")
    return [RemotePath(filesystem.unstrip_protocol(name)) for name in found]


@contextmanager
def local_copies(place: Path | None = None) -> Iterator[None]:
    """Inside, each recording at a URL is fetched once, to the disk of this host, and deleted at the end.

    place: a folder for the copies, whose owner deletes it even if this process is killed; another host has none.
    """
    folder_of_host = place if place and place.is_dir() else None
    with TemporaryDirectory(prefix="fantwin-copies-", dir=folder_of_host) as folder:
        token = _COPIES.set(Path(folder))
        try:
            yield
        finally:
            _COPIES.reset(token)


@contextmanager
def without_copies() -> Iterator[None]:
    """Inside, files at URLs are read where they are, for work that needs only their beginning."""
    token = _COPIES.set(None)
    try:
        yield
    finally:
        _COPIES.reset(token)


class RemotePath(PosixPath):
    """The path of a file at a URL. It can be opened for reading, and nothing else."""

    def __str__(self) -> str:
        return super().__str__().replace(":/", "://", 1)

    def open(self, mode: str = "r", *_args: Any, **_options: Any) -> Any:
        """Open the file for reading bytes: a binary file.

        Raises:
            RecordingError: it cannot be fetched.
        """
        if mode != "rb":
            raise io.UnsupportedOperation(f"{self}: mode {mode!r}")
        copies = _COPIES.get()
        if copies is None:
            return self._remote()
        copy = copies / hashlib.sha256(str(self).encode()).hexdigest()
        if not copy.exists():
            fetched = copy.with_suffix(".part")
            with self._remote() as source, fetched.open("wb") as target:
                try:
                    shutil.copyfileobj(source, target, 16 * _BLOCK_BYTES)
                except Exception as error:
                    raise self.unreadable(error) from error
            fetched.rename(copy)
        return copy.open("rb")

    def place(self) -> tuple[Any, str]:
        """The file system of fsspec, and the path in it.

        Raises:
            RecordingError: there is none for this kind of URL.
        """
        import fsspec  # noqa: PLC0415  an extra

        try:
            return fsspec.url_to_fs(str(self))
        except Exception as error:
            raise self.unreadable(error) from error

    def unreadable(self, error: Exception) -> RecordingError:
        """Any error of a store as one line."""
        reason = "there is no such file" if isinstance(error, FileNotFoundError) else " ".join(str(error).split())
        return RecordingError(f"{self}: cannot read the recording: {reason or type(error).__name__}")

    def _remote(self) -> IO[bytes]:
        filesystem, path = self.place()
        try:
            return filesystem.open(path, "rb", block_size=_BLOCK_BYTES)
        except Exception as error:
            raise self.unreadable(error) from error
