"""Mending torn recordings: everything whole is kept byte for byte, and a ledger, an index and an end are put behind it.

Nothing is taken away before its replacement is on the disk. See docs/reference/recordings.md.
"""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from itertools import chain, count
from pathlib import Path

from mcap.writer import MCAP0_MAGIC

from pipeline.recordings.contents import NOTHING_WHOLE, unaccounted
from pipeline.recordings.disk import AtomicAppendFile, refused, sync_folder, unwritten
from pipeline.recordings.index import SHORT_ENDING
from pipeline.recordings.reading import RecordingError
from pipeline.recordings.scan import Scan, scan
from pipeline.recordings.writing import ACTIVE_SUFFIX, free_name, write_ending

TORN_SUFFIX = ".torn"
_UNFINISHED_SUFFIX = ".recovering"
_COPY_BYTES = 1 << 20


@dataclass(frozen=True)
class Recovery:
    """What became of a file."""

    found: Scan
    path: Path
    """the file that is whole now"""
    torn: Path | None = None
    """what the torn one is called now, if it had to make room for the whole one"""


def recover(path: Path, output: Path | None = None) -> Recovery:
    """Make a whole recording of a torn one. A file that is whole already is left as it is, or copied to `output`.

    output: without it the whole file takes the name of the torn one (without `.active`), which is kept as NAME.torn.

    Raises:
        RecordingError: the file cannot be read, is being written, or holds no whole message, or the other one exists
            or cannot be written.
    """
    if output is not None and output.exists():
        raise RecordingError(f"{output}: exists; name another file with -o")
    try:
        with unwritten(path):
            return _recover(path, output)
    except BlockingIOError as error:
        raise RecordingError(f"{path}: a recorder is writing it; stop it first") from error
    except OSError as error:
        raise RecordingError(f"{path}: cannot read the recording: {error.strerror}") from error


def mend(active: Path) -> Recovery | None:
    """Make a recording of what a killed recorder has left, in place: that takes little room, and less time than a copy.

    It is given the name of a recording. None where it held no message and was removed.

    Raises:
        BlockingIOError: a recorder is writing it.
        OSError: it cannot be written.
        RecordingError: it cannot be read, or is no recording.
    """
    file = AtomicAppendFile(active, keep=True)
    try:
        found = _scan_of_left_over(active)
        if found is None or not (found.messages or found.is_damaged):
            active.unlink()
            return None
        if not found.is_whole and (found.is_damaged or not found.fits):
            return _recover(active, None)
        if not found.is_whole:
            file.cut(found.solid_end)
            try:
                _end(file, found, before=found.tail)
            except OSError:
                with suppress(OSError):
                    file.write(SHORT_ENDING)
                    file.sync()
        name = _finished_name(active)
        active.rename(name)
        sync_folder(name.parent)
        return Recovery(found, name)
    finally:
        file.close()


def _scan_of_left_over(active: Path) -> Scan | None:
    with active.open("rb") as file:
        begun = file.read(len(MCAP0_MAGIC))
    return None if len(begun) < len(MCAP0_MAGIC) else scan(active)


def _recover(path: Path, output: Path | None) -> Recovery:
    found = scan(path)
    if found.is_whole and output is None and not path.name.endswith(ACTIVE_SUFFIX):
        return Recovery(found, path)
    if not found.messages and not found.is_whole:
        raise RecordingError(f"{path}: there is no whole message in it: nothing can be recovered")
    target = output or _finished_name(path)
    unfinished = target.with_name(target.name + _UNFINISHED_SUFFIX)
    torn = None
    try:
        if found.is_whole and output is None:
            path.rename(target)
            sync_folder(target.parent)
            return Recovery(found, target)
        _write(unfinished, lambda file: _copy(found, file))
        if output is None:
            torn = free_torn_name(target)
            _give_second_name(path, torn)
        unfinished.replace(target)
        sync_folder(target.parent)
        if output is None and path != target:
            path.unlink(missing_ok=True)
    except OSError as error:
        is_full = error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
        advice = "make room" if is_full else "name another file with -o"
        raise refused(f"{target}: cannot be written", error, f"{path.name} is left as it was; {advice}") from error
    return Recovery(found, target, torn)


def _give_second_name(path: Path, name: Path) -> None:
    """So that a kill at any moment leaves it under one of them."""
    try:
        os.link(path, name)
        sync_folder(path.parent)
    except OSError:  # a disk without links
        path.rename(name)


def _write(path: Path, fill: Callable[[AtomicAppendFile], None]) -> None:
    """Make a file; none if that fails. OSError in that case."""
    file = AtomicAppendFile(path)
    try:
        fill(file)
        file.sync()
    except BaseException:
        path.unlink()
        raise
    finally:
        file.close()


def _copy(found: Scan, file: AtomicAppendFile) -> None:
    """All that is whole of a file, and an ending."""
    if found.is_whole or (found.fits and not found.is_damaged):
        left = found.walk.size if found.is_whole else found.solid_end
        with found.path.open("rb") as source:
            while left and (block := source.read(min(left, _COPY_BYTES))):
                file.write(block)
                left -= len(block)
        if not found.is_whole:
            _end(file, found, before=found.tail)
        return

    def keep(data: bytes) -> int:
        offset = file.size
        file.write(data)
        return offset

    file.write(MCAP0_MAGIC)
    again = scan(found.path, keep)
    _end(file, again)


def _end(file: AtomicAppendFile, found: Scan, before: bytes = b"") -> None:
    """Write an ending that tells what was lost. OSError if the disk refuses."""
    write_ending(file, found.index, found.accounts, before=before, has_ended=found.has_ended, recovered=_said_of(found))


def _said_of(found: Scan) -> list[str]:
    """The losses that its accounts do not show. An unfinished chunk at the end is told as the end that is lacking."""
    tail = not found.is_ended and not found.is_damaged
    return [line for line in unaccounted(found) if not (tail and line.startswith(NOTHING_WHOLE))]


def _finished_name(path: Path) -> Path:
    if not path.name.endswith(ACTIVE_SUFFIX):
        return path
    return free_name(path.with_name(path.name.removesuffix(ACTIVE_SUFFIX)))


def free_torn_name(target: Path) -> Path:
    """What a torn file is called that has to make room for `target`."""
    torn = target.with_name(target.name + TORN_SUFFIX)
    names = chain([torn], (torn.with_name(f"{torn.name}-{number}") for number in count(2)))
    return next(name for name in names if not name.exists())
