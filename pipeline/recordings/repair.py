"""Repair of truncated and damaged recordings: every intact message is kept, and the file gets a ledger, index and end.

What a killed recorder left is ended in place: that needs little room and no copy. Every other repair
writes a new file. Nothing is removed before its replacement is on the disk. See docs/reference/recordings.md.
"""

from __future__ import annotations

import errno
import os
import shutil
from dataclasses import dataclass
from itertools import chain, count
from pathlib import Path
from typing import BinaryIO

from mcap.opcode import Opcode
from mcap.records import Attachment, Chunk, Metadata
from mcap.writer import MCAP0_MAGIC, Writer

from fantwin.pipeline.files import sync_folder
from fantwin.pipeline.recordings.contents import losses_outside_counts
from fantwin.pipeline.recordings.disk import AtomicAppendFile, not_being_written, refused
from fantwin.pipeline.recordings.ending import write_ending
from fantwin.pipeline.recordings.records import (
    ACTIVE_SUFFIX,
    MESSAGE,
    RecordingError,
    RecordReader,
    chunk_data,
    records_in,
)
from fantwin.pipeline.recordings.scan import NOT_A_RECORD, Contents, scan
from fantwin.pipeline.recordings.sequence_ledger import LEDGER_NAME, ledger_metadata
from fantwin.pipeline.recordings.writing import CHUNK_BYTES, free_name

ORIGINAL_SUFFIX = ".original"
_UNFINISHED_SUFFIX = ".recovering"


@dataclass(frozen=True)
class Recovery:
    """The result of a repair."""

    found: Contents
    path: Path
    """the repaired file"""
    original: Path | None = None
    """the new name of the file before the repair, if it had to make room for the repaired one"""


def recover(path: Path, output: Path | None = None) -> Recovery:
    """Write a repaired copy of a recording. An intact file is left as it is, or copied to `output`.

    output: without it the repaired file takes the name of the recording (without `.active`), and the file before the
        repair is kept as NAME.original.

    Raises:
        RecordingError: the file cannot be read, is being written, or holds no intact message; or the output exists or
            cannot be written.
    """
    if output is not None and output.exists():
        raise RecordingError(f"{output}: exists; name another file with -o")
    try:
        with not_being_written(path):
            return _recover(path, output)
    except BlockingIOError as error:
        raise RecordingError(f"{path}: a recorder is writing it; stop it first") from error
    except OSError as error:
        raise RecordingError(f"{path}: cannot read the recording: {error.strerror}") from error


def repair_in_place(active: Path) -> Recovery | None:
    """Make a recording of what a killed recorder left, and give it the name of one; a damaged file is copied.

    Returns None if the file held no message and was removed.

    Raises:
        BlockingIOError: a recorder is writing it.
        OSError: it cannot be written.
        RecordingError: it cannot be read, or is not a recording.
    """
    file = AtomicAppendFile(active, keep=True)
    try:
        found = scan(active) if file.size >= len(MCAP0_MAGIC) else None
        if found is None or not (found.messages or found.is_damaged):
            active.unlink()
            return None
        if found.is_damaged:
            return _recover(active, None)
        if not found.reader.is_complete:
            write_ending(active, file, found, _ledger_of(found))
        name = _finished_name(active)
        active.rename(name)
        sync_folder(name.parent)
        return Recovery(found, name)
    finally:
        file.close()


def _recover(path: Path, output: Path | None) -> Recovery:
    found = scan(path)
    if found.is_intact and output is None and not path.name.endswith(ACTIVE_SUFFIX):
        return Recovery(found, path)
    if not found.messages and not found.is_intact:
        raise RecordingError(f"{path}: it holds no intact message: nothing can be recovered")
    target = output or _finished_name(path)
    original = None
    try:
        if found.is_intact and output is None:
            path.rename(target)
            sync_folder(target.parent)
            return Recovery(found, target)
        unfinished = _written_copy(found, target)
        if output is None:
            original = free_original_name(target)
            _add_name(path, original)
        unfinished.replace(target)
        sync_folder(target.parent)
        if output is None and path != target:
            path.unlink(missing_ok=True)
    except OSError as error:
        is_full = error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
        advice = "make room" if is_full else "name another file with -o"
        raise refused(f"{target}: cannot be written", error, f"{path.name} is left as it was; {advice}") from error
    return Recovery(found, target, original)


def _add_name(path: Path, name: Path) -> None:
    """Give a file a second name, so that a kill at any moment leaves it under one of the two."""
    try:
        os.link(path, name)
        sync_folder(path.parent)
    except OSError:  # a file system without links
        path.rename(name)


def _written_copy(found: Contents, target: Path) -> Path:
    """A repaired copy, on the disk under a temporary name. Raises OSError, and leaves no file then."""
    unfinished = target.with_name(target.name + _UNFINISHED_SUFFIX)
    lock = AtomicAppendFile(unfinished)  # against a second repair to the same target
    try:
        with unfinished.open("wb") as file:
            if found.is_intact:
                with found.path.open("rb") as source:
                    shutil.copyfileobj(source, file)
            else:
                _write_repaired(found, file)
            file.flush()
            os.fsync(file.fileno())
    except BaseException:
        unfinished.unlink(missing_ok=True)
        raise
    finally:
        lock.close()
    return unfinished


def _write_repaired(found: Contents, file: BinaryIO) -> None:
    """Write everything intact in a file, and a ledger that names what was lost."""
    writer = Writer(file, CHUNK_BYTES)
    writer.start(found.profile, "fantwin")
    schemas = {s.id: writer.register_schema(s.name, s.encoding, s.data) for s in found.schemas.values()}
    channels = {
        c.id: writer.register_channel(c.topic, c.message_encoding, schemas.get(c.schema_id, 0), c.metadata)
        for c in found.channels.values()
    }
    for record in RecordReader(found.path, for_repair=True):
        if record.offset in found.damaged_offsets:
            continue
        data = b""
        match record.parsed:
            case Metadata(name=name, metadata=metadata):
                if name == LEDGER_NAME:
                    break
                writer.add_metadata(name, metadata)
            case Attachment() as a:
                writer.add_attachment(a.create_time, a.log_time, a.name, a.media_type, a.data)
            case Chunk() as chunk:
                data = chunk_data(chunk)
            case None if record.opcode == Opcode.MESSAGE:
                data = record.data
            case None if record.opcode == Opcode.DATA_END:
                break
            case _:
                pass
        for _, opcode, start, end in records_in(data):
            if opcode == Opcode.MESSAGE:
                channel, sequence, log_time_ns, publish_time_ns = MESSAGE.unpack_from(data, start)
                if channel in channels:
                    payload = data[start + MESSAGE.size : end]
                    writer.add_message(channels[channel], log_time_ns, payload, publish_time_ns, sequence)
    writer.flush()
    writer.add_metadata(LEDGER_NAME, _ledger_of(found))
    writer.finish()


def _ledger_of(found: Contents) -> dict[str, str]:
    """The ledger of a repaired file, with the losses that its counts do not show.

    The bytes of an unfinished chunk at the end are not listed: the missing end is.
    """
    at_the_end_only = not found.is_ended and not found.is_damaged
    lost = [line for line in losses_outside_counts(found) if not (at_the_end_only and line.startswith(NOT_A_RECORD))]
    return ledger_metadata(found.streams, has_ended=found.has_ended, recovered=lost)


def _finished_name(path: Path) -> Path:
    if not path.name.endswith(ACTIVE_SUFFIX):
        return path
    return free_name(path.with_name(path.name.removesuffix(ACTIVE_SUFFIX)))


def free_original_name(target: Path) -> Path:
    """The first free name for a file that has to make room for `target`."""
    original = target.with_name(target.name + ORIGINAL_SUFFIX)
    names = chain([original], (original.with_name(f"{original.name}-{number}") for number in count(2)))
    return next(name for name in names if not name.exists())
