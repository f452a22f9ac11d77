"""The parts of a recorder's recording: NAME.mcap, NAME-2.mcap, NAME-3.mcap and so on, each complete in itself.

A part says in its metadata which one it is, of which session of the recorder, and which part went before. What a killed
recorder has left is mended, and the parts go on from it.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path

from pipeline.recordings.contents import Contents, contents_of
from pipeline.recordings.disk import Disk, DiskError, refused, sync_folder
from pipeline.recordings.reading import RecordingError, read_metadata
from pipeline.recordings.repair import TORN_SUFFIX, Recovery, free_torn_name, mend
from pipeline.recordings.sequence_ledger import SequenceLedger
from pipeline.recordings.writing import ACTIVE_SUFFIX, RecordingWriter


class RecordingParts:
    """Where the parts of one recording stand, and begin."""

    def __init__(self, path: Path, metadata: Mapping[str, str], attachments: Mapping[str, bytes], session: str) -> None:
        """Mend what a killed recorder has left there.

        Args:
            path: NAME.mcap.
            metadata: of every part.
            attachments: the same.
            session: of the recorder; new at each of its starts.

        Raises:
            RecordingError: nothing can be recorded there, or another recorder does.
        """
        self._path = path
        self._metadata = dict(metadata) | {"session": session, "recording": path.name}
        self._attachments = attachments
        self._part = 0
        self.mended: list[Recovery] = []
        """what killed recorders had left"""
        self.unreadable: list[Path] = []
        """what they had left and cannot be mended: put aside"""
        self.unmended: list[Path] = []
        """what they had left and the disk refuses to mend for now: left as it is"""
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._disk = Disk(path.parent)
            self._mend()
            self._number = max((number for number, _ in self._files()), default=0)
        except OSError as error:
            raise refused(f"{path}: cannot be written", error, "name another file or folder") from error
        last = self._last_part()
        self._continues = last.path.name.removesuffix(ACTIVE_SUFFIX) if last else ""
        self.before = last.next if last else {}
        """of each key and producer, the sequence number that is due after the last part there is"""

    def begin(self, t_ns: int, ledger: SequenceLedger, about: Mapping[str, str]) -> RecordingWriter:
        """Begin the next part, at `t_ns`. about: what is special about it, for its metadata.

        Raises:
            RecordingError: it cannot be written.
        """
        self._number += 1
        metadata = {
            **self._metadata,
            "part": str(self._part + 1),
            "started": datetime.fromtimestamp(t_ns / 1e9, UTC).isoformat(timespec="milliseconds"),
            "started_t_ns": str(t_ns),
            **({"continues": self._continues} if self._continues else {}),
            **about,
        }
        self.free_bytes()  # never beneath the place of a disk that has gone
        try:
            writer = RecordingWriter(self._name(self._number), metadata, self._attachments, t_ns=t_ns, ledger=ledger)
        except RecordingError:
            self._number -= 1
            raise
        self._part += 1
        self._continues = writer.path.name
        return writer

    def free_bytes(self) -> int:
        """How much room the disk has.

        Raises:
            DiskError: it has gone.
        """
        return self._disk.free_bytes()

    def delete_oldest(self) -> str | None:
        """Delete the oldest finished part and give its name; None if there is none."""
        for _, path in sorted(self._files()):
            if path.suffix == self._path.suffix and self._is_ours(path):
                with suppress(OSError):
                    path.unlink()
                    return path.name
        return None

    def _name(self, number: int) -> Path:
        return self._path if number == 1 else self._path.with_stem(f"{self._path.stem}-{number}")

    def _files(self) -> list[tuple[int, Path]]:
        """The parts there are, finished or not or torn, with their numbers."""
        stem, suffix = re.escape(self._path.stem), re.escape(self._path.suffix)
        pattern = re.compile(rf"{stem}(?:-(\d+))?{suffix}({re.escape(ACTIVE_SUFFIX)}|{re.escape(TORN_SUFFIX)})?")
        matches = ((pattern.fullmatch(path.name), path) for path in self._path.parent.iterdir())
        return [(int(match[1] or 1), path) for match, path in matches if match]

    def _is_ours(self, path: Path) -> bool:
        try:
            return read_metadata(path).metadata.get("recording") == self._path.name
        except RecordingError:
            return False

    def _mend(self) -> None:
        for _, path in sorted(self._files()):
            if not path.name.endswith(ACTIVE_SUFFIX):
                continue
            try:
                recovery = mend(path)
            except BlockingIOError as error:
                raise RecordingError(
                    f"{path}: another recorder is writing it; stop it, or name another file"
                ) from error
            except DiskError:
                self.unmended.append(path)
                continue
            except RecordingError:
                aside = free_torn_name(path.with_name(path.name.removesuffix(ACTIVE_SUFFIX)))
                self.unreadable.append(path.rename(aside))
                sync_folder(aside.parent)
                continue
            if recovery:
                self.mended.append(recovery)

    def _last_part(self) -> Contents | None:
        """The last part of ours."""
        for _, path in sorted(self._files(), reverse=True):
            if (path.suffix == self._path.suffix or path in self.unmended) and self._is_ours(path):
                return contents_of(path)
        return None
