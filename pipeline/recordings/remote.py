"""Recordings at URLs, such as s3://bucket/site/day.mcap, wherever fsspec can read (extra `remote`).

A path whose bytes are elsewhere: its text is the URL, and all that reads recordings opens it like a file. It does so
inside `local_copies`, where a recording is fetched once, since most work reads it several times.
"""

from __future__ import annotations

import hashlib
import io
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path, PosixPath
from tempfile import TemporaryDirectory
from typing import Any

from fantwin.pipeline.errors import UsageError
from fantwin.pipeline.extras import missing_extra
from fantwin.pipeline.recordings.records import RecordingError

_MAY_BE_SECRET = re.compile(r"://[^/@]*:[^/@]*@|https?://[^/@]*@|\?")
"""a password, a token, or a query, such as a signature"""
_COPIES: ContextVar[Path] = ContextVar("copies")
"""the folder of local copies"""


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
    if problem := missing_extra(f"{text}: a recording at a URL", "remote", "fsspec"):
        raise UsageError(problem)
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


class RemotePath(PosixPath):
    """The path of a file at a URL. It can be opened for reading, and nothing else."""

    def __str__(self) -> str:
        return super().__str__().replace(":/", "://", 1)

    def open(self, mode: str = "r", *_args: Any, **_options: Any) -> Any:
        """Open a copy for reading bytes, inside `local_copies`: a binary file.

        Raises:
            RecordingError: it cannot be fetched.
        """
        if mode != "rb":
            raise io.UnsupportedOperation(f"{self}: mode {mode!r}")
        copy = _COPIES.get() / hashlib.sha256(str(self).encode()).hexdigest()
        if not copy.exists():
            filesystem, path = self.place()
            fetched = copy.with_suffix(".part")
            try:
                filesystem.get_file(path, str(fetched))
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
