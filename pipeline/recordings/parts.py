"""The parts of a recording, NAME.mcap, NAME-2.mcap and so on, each complete in itself: in order, each message once.

The metadata of a part say its number, the session of the recorder, and the part before it. What a killed recorder left
is repaired, and the next part continues it.
"""

from __future__ import annotations

import re
from bisect import bisect_right
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import suppress
from datetime import UTC, datetime
from itertools import islice
from pathlib import Path

from fantwin.pipeline.files import sync_folder
from fantwin.pipeline.recordings.contents import contents_of
from fantwin.pipeline.recordings.disk import Disk, DiskError, refused
from fantwin.pipeline.recordings.indexed import last_messages
from fantwin.pipeline.recordings.reading import RecordingError, read_metadata, read_recording
from fantwin.pipeline.recordings.records import ACTIVE_SUFFIX, UnreadableError, whole_number
from fantwin.pipeline.recordings.repair import (
    ORIGINAL_SUFFIX,
    free_original_name,
    repair_in_place,
)
from fantwin.pipeline.recordings.run_recordings import RECORDING_KEY, recorded_files
from fantwin.pipeline.recordings.scan import Contents
from fantwin.pipeline.recordings.sequence_ledger import SequenceLedger
from fantwin.pipeline.recordings.stored_recordings import Stored, StoredPart, StoredRecordings
from fantwin.pipeline.recordings.writing import RecordingWriter
from fantwin.schemas.envelope import Envelope
from fantwin.schemas.streams import StreamId


def in_order(parts: Iterable[Path]) -> list[Path]:
    """The parts of a recording, or of the recordings of several shards, the earliest first. A folder stands for the
    recordings in it.

    Raises:
        RecordingError: one cannot be read, or was not made by a recorder and so is not a part.
    """
    paths = recorded_files(parts)
    if len(paths) > 1:
        for path in paths:
            if "source" in read_metadata(path).metadata:  # its sequence numbers start at 0, as those of the next do
                raise RecordingError(
                    f"{path}: made by import, simulate or an offline replay, so it is not a part: read it by itself"
                )
        paths = _sessions_in_order(paths)
    elif paths:
        read_recording(paths[0])
    return paths


def _sessions_in_order(paths: Iterable[Path]) -> list[Path]:
    """By the start of each recorder session, then by part number: the host's clock may be set back between parts."""
    sessions: dict[str, list[tuple[int, int, Path]]] = {}
    for path in paths:
        metadata = read_metadata(path).metadata
        numbered = (whole_number(metadata.get("part", "")) or 0, _start_ns(path), path)
        sessions.setdefault(metadata.get("session") or str(path), []).append(numbered)
    ordered = [sorted(parts) for parts in sessions.values()]
    return [path for parts in sorted(ordered, key=lambda parts: parts[0][1]) for _, _, path in parts]


def _start_ns(path: Path) -> int:
    """When its first message was received; 0 without any, since its place does not matter then."""
    return next((envelope.received_t_ns for envelope in read_recording(path)), 0)


class Seen:
    """The messages that have come: of each stream the sequence numbers as ranges, one more than there are gaps."""

    def __init__(self) -> None:
        self.repeated = 0
        """messages that came again"""
        self._ranges: dict[StreamId, tuple[list[int], list[int]]] = {}
        """of each range its first number, and the one after its last"""

    def is_new(self, envelope: Envelope) -> bool:
        """Add a message. Returns whether it came for the first time."""
        header = envelope.header
        first, following = self._ranges.setdefault((envelope.key, header.producer), ([], []))
        sequence = header.sequence
        at = bisect_right(first, sequence)  # the range before it may hold or touch it
        if at and sequence < following[at - 1]:
            self.repeated += 1
            return False
        joins_next = at < len(first) and sequence + 1 == first[at]
        if at and sequence == following[at - 1]:
            following[at - 1] = following.pop(at) if joins_next else sequence + 1
            if joins_next:
                del first[at]
        elif joins_next:
            first[at] = sequence
        else:
            first.insert(at, sequence)
            following.insert(at, sequence + 1)
        return True


def read_parts(
    parts: Iterable[Path], topics: Collection[str], damage: list[str], tray: str | None = None, seen: Seen | None = None
) -> Iterator[Envelope]:
    """The messages of parts, each once: one may be in two of them after a restart. damage: gets a line for each part
    that could not be read in full."""
    seen = seen or Seen()
    for part in parts:
        reading = read_recording(part, topics, tray)
        yield from filter(seen.is_new, reading)
        damage += [reading.damage] if reading.damage else []


PARTS_SEARCHED = 3
"""for the last messages of a topic"""


def part_path(path: Path, number: int) -> Path:
    """The name of a finished part. path: NAME.mcap."""
    return path if number == 1 else path.with_stem(f"{path.stem}-{number}")


def part_files(path: Path) -> list[tuple[int, Path]]:
    """All files of the parts of NAME.mcap with their numbers: finished, active, and originals of repaired ones.

    Raises:
        OSError: the folder cannot be read.
    """
    stem, suffix = re.escape(path.stem), re.escape(path.suffix)
    others = "|".join(map(re.escape, (ACTIVE_SUFFIX, ORIGINAL_SUFFIX)))
    pattern = re.compile(rf"{stem}(?:-(\d+))?{suffix}({others})?")
    paths = path.parent.iterdir() if path.parent.is_dir() else ()
    matches = ((pattern.fullmatch(path.name), path) for path in paths)
    return [(int(match[1] or 1), path) for match, path in matches if match]


class RecordingParts:
    """The folder of one recording: its parts so far, and the next one."""

    def __init__(self, path: Path, metadata: Mapping[str, str], attachments: Mapping[str, bytes], session: str) -> None:
        """Repair what a killed recorder left there.

        Args:
            path: NAME.mcap.
            metadata: of every part.
            attachments: of every part.
            session: an id, new at each start of the recorder.

        Raises:
            RecordingError: nothing can be recorded there, or another recorder does.
        """
        self.path = path
        self._metadata = dict(metadata) | {"session": session, RECORDING_KEY: path.name}
        self._attachments = attachments
        self._part = 0
        self.remarks: list[str] = []
        """what became of files that killed recorders had left, a line each"""
        self._unrepaired: list[Path] = []
        """such files whose repair the disk refuses for now; left as they are"""
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._disk = Disk(path.parent)
            self._stored = StoredRecordings(path.parent)
            self._repair()
            self._number = max((number for number, _ in part_files(self.path)), default=0)
        except OSError as error:
            raise refused(f"{path}: cannot be written", error, "name another file or folder") from error
        last = self._last_part()
        self._last = last.path if last else None
        """the part before the next one"""
        self._writer: RecordingWriter | None = None
        self.before = last.next if last else {}
        """the sequence number due of each stream after the last part"""

    def begin(self, t_ns: int, ledger: SequenceLedger, about: Mapping[str, str]) -> RecordingWriter:
        """Begin the next part, at `t_ns`. about: metadata of this part only.

        Raises:
            RecordingError: it cannot be written.
        """
        self.free_bytes()  # raises if the disk is gone: do not write to its mount point
        try:
            self._number = 1 + max([self._number, *(number for number, _ in part_files(self.path))])
        except OSError as error:
            raise refused(f"{self.path.parent}: cannot be read", error, "name another folder") from error
        if self._writer:
            self._last = self._writer.path  # it may have been given another name since it began
        metadata = {
            **self._metadata,
            "part": str(self._part + 1),
            "started": datetime.fromtimestamp(t_ns / 1e9, UTC).isoformat(timespec="milliseconds"),
            "started_t_ns": str(t_ns),
            **({"continues": self._last.name.removesuffix(ACTIVE_SUFFIX)} if self._last else {}),
            **about,
        }
        try:
            writer = RecordingWriter(
                part_path(self.path, self._number), metadata, self._attachments, t_ns=t_ns, ledger=ledger
            )
        except RecordingError:
            self._number -= 1
            raise
        self._part += 1
        self._writer = writer
        return writer

    def last_messages(self, topic: str) -> dict[str, bytes]:
        """The last message of a topic on each key in the last parts of this recording, as bytes."""
        found: dict[str, bytes] = {}
        with suppress(OSError):
            files = sorted(part_files(self.path), reverse=True)
            ours = (path for _, path in files if path.suffix == self.path.suffix and self._is_ours(path))
            for path in islice(ours, PARTS_SEARCHED):
                with suppress(RecordingError):
                    found = last_messages(path, topic) | found
        return found

    def free_bytes(self) -> int:
        """Free space on the disk.

        Raises:
            DiskError: the disk is gone.
        """
        return self._disk.free_bytes()

    def disk_bytes(self) -> int:
        """Size of the disk. Raises DiskError as `free_bytes` does."""
        return self._disk.size_bytes()

    def stored(self) -> Stored:
        """What recordings and clips there are in the folder; nothing if the folder is gone.

        Raises:
            RecordingError: it cannot be read, or the folder of its clips cannot.
        """
        try:
            return self._stored.look()
        except FileNotFoundError:
            return Stored()
        except OSError as error:
            what = f"{error.filename or self.path.parent}: cannot be read"
            raise refused(what, error, "no recording is deleted until it can be") from error

    def delete(self, part: StoredPart) -> None:
        """Delete a finished part.

        Raises:
            RecordingError: it cannot be deleted.
        """
        try:
            part.path.unlink(missing_ok=True)
        except OSError as error:
            advice = "other recordings are kept until this file is gone: delete it or move it"
            raise refused(f"{part.path}: cannot be deleted", error, advice) from error

    def _is_ours(self, path: Path) -> bool:
        try:
            return read_metadata(path).metadata.get(RECORDING_KEY) == self.path.name
        except RecordingError:
            return False

    def _repair(self) -> None:
        for _, path in sorted(part_files(self.path)):
            if not path.name.endswith(ACTIVE_SUFFIX):
                continue
            try:
                recovery = repair_in_place(path)
            except BlockingIOError as error:
                raise RecordingError(
                    f"{path}: another recorder is writing it; stop it, or name another file"
                ) from error
            except (DiskError, UnreadableError):
                self._unrepaired.append(path)
                became = (
                    f"the disk refuses the repair of its recording, which stays {path}: make room and start again, or "
                    "use `fantwin info --repair`"
                )
            except RecordingError as error:
                aside = free_original_name(path.with_name(path.name.removesuffix(ACTIVE_SUFFIX)))
                path.rename(aside)
                sync_folder(aside.parent)
                became = f"its recording cannot be repaired and was renamed to {aside.name}: {error}"
            else:
                if recovery is None:
                    continue
                became = (
                    f"its recording was repaired and is {recovery.path}: {recovery.found.messages} messages; bytes of "
                    f"an unfinished chunk discarded: {recovery.found.discarded_bytes}"
                )
            self.remarks.append(f"a recorder was killed; {became}")

    def _last_part(self) -> Contents | None:
        """The contents of the last part of this recording."""
        for _, path in sorted(part_files(self.path), reverse=True):
            if (path.suffix == self.path.suffix or path in self._unrepaired) and self._is_ours(path):
                return contents_of(path)
        return None
